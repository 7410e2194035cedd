"""How far the simulated car is from recorded cars that were sent the same actions.

    python -m benchmarks.fidelity --traces DIR [--held-out] [--car NAME] [--json FILE] [--figures DIR]

Takes the traces or logs of any generation. docs/fidelity.md explains the measure.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.calibrate import FIT_STEPS, REPORT_STEPS, car_named, held_out
from benchmarks.replay import WARM_UP_STEPS, Windows, cut_windows, errors, replay
from benchmarks.report import benchmark_parser, number, table, write_json
from deepracer_exp.config.car import CarConfig
from deepracer_exp.deepracer.recording_reader import read_recording
from deepracer_exp.errors import BadInput, RunFailed

Floats = NDArray[np.float64]
WANTED_M = 0.06
LENGTHS = {"one_second": FIT_STEPS, "three_second": REPORT_STEPS}
MODELS = ("car", "formula", "bicycle")


def bicycle(car: CarConfig, windows: Windows) -> Floats:
    """Predict with the kinematic bicycle, commanded speed and steering reached at once.

    Returns:
        x_m, y_m and yaw_rad after each step, (M, steps, 3).
    """
    period, ratio = car.control_period_s, -car.rear_axle_x_m / car.wheelbase_m
    x, y, yaw = windows.start.T
    driven = np.empty_like(windows.truth)
    for step in range(windows.steps):
        speed, steering = windows.action[:, WARM_UP_STEPS + step].T
        rate = speed * np.tan(steering) / car.wheelbase_m
        # The origin is ahead of the rear axle, which goes where it points.
        course = yaw + 0.5 * period * rate + np.arctan(ratio * np.tan(steering))
        along = speed * np.hypot(1.0, ratio * np.tan(steering)) * period
        x, y, yaw = x + along * np.cos(course), y + along * np.sin(course), yaw + period * rate
        driven[:, step] = np.stack([x, y, yaw], axis=-1)
    return driven


class Formula(NamedTuple):
    """Speed and yaw rate follow what is commanded, each with a lag of its own."""

    speed_ratio: float = 1.0
    speed_lag_s: float = 0.2
    trim_rad: float = 0.0
    gain: float = 0.7
    """Share of the bicycle's yaw rate that is reached."""
    gain_loss: float = 0.05
    """How much of the share is lost with the square of the speed, s2/m2."""
    rate_lag_s: float = 0.5
    speed_correction: float = 0.3
    """Share of the warm-up's errors by which speed and yaw rate are corrected, as `benchmarks.replay.Observer`."""
    rate_correction: float = 0.5

    def predict(self, car: CarConfig, windows: Windows) -> Floats:
        """Return x_m, y_m and yaw_rad after each step, (M, steps, 3)."""
        period = car.control_period_s
        x, y, yaw = windows.pose[:, 0].T
        speed, rate = np.zeros(len(windows)), np.zeros(len(windows))
        keep_speed, keep_rate = np.exp(-period / self.speed_lag_s), np.exp(-period / self.rate_lag_s)
        driven = np.empty_like(windows.truth)
        for step in range(windows.action.shape[1]):
            known = step >= windows.first
            commanded, steering = windows.action[:, step].T
            to_speed = self.speed_ratio * commanded
            to_rate = (
                (self.gain - self.gain_loss * speed**2)
                * speed
                * np.tan(steering + self.trim_rad)
                / car.wheelbase_m
            )
            new_speed = np.where(known, to_speed + keep_speed * (speed - to_speed), 0.0)
            new_rate = np.where(known, to_rate + keep_rate * (rate - to_rate), 0.0)
            along, turn = 0.5 * period * (speed + new_speed), 0.5 * period * (rate + new_rate)
            x, y = x + along * np.cos(yaw + 0.5 * turn), y + along * np.sin(yaw + 0.5 * turn)
            yaw, speed, rate = yaw + turn, new_speed, new_rate
            if step >= WARM_UP_STEPS:
                driven[:, step - WARM_UP_STEPS] = np.stack([x, y, yaw], axis=-1)
                continue
            recorded = windows.pose[:, step + 1]
            ahead = np.cos(yaw) * (recorded[:, 0] - x) + np.sin(yaw) * (recorded[:, 1] - y)
            turned = np.remainder(recorded[:, 2] - yaw + np.pi, 2.0 * np.pi) - np.pi
            speed = np.where(known, speed + self.speed_correction * ahead / period, 0.0)
            rate = np.where(known, rate + self.rate_correction * turned / period, 0.0)
            x, y, yaw = recorded.T
            if step == WARM_UP_STEPS - 1:
                speed, rate = np.where(windows.standing, 0.0, speed), np.where(windows.standing, 0.0, rate)
        return driven


def fit_formula(car: CarConfig, windows: Windows) -> Formula:
    """Return the formula that predicts the windows best."""
    begin = np.array(Formula())

    def residuals(values: Floats) -> Floats:
        off = errors(Formula(*values).predict(car, windows), windows)
        return np.concatenate([off.x_m.ravel(), off.y_m.ravel()]) / 0.08

    low = [0.5, 0.02, -0.2, 0.0, -0.2, 0.02, 0.0, 0.0]
    high = [1.5, 2.0, 0.2, 2.0, 0.5, 3.0, 1.0, 2.0]
    found = least_squares(residuals, begin, loss="soft_l1", bounds=(low, high), max_nfev=30)
    return Formula(*map(float, found.x))


def measure(car: CarConfig, recorded: pd.DataFrame, only_held_out: bool, threads: int) -> dict[str, Any]:
    """Return the median errors of the car, the fitted formula and the bicycle on the same windows.

    Raises:
        BadInput: the recordings have no window.
    """
    figures: dict[str, Any] = {}
    formula = None
    for length, steps in LENGTHS.items():
        windows = cut_windows(recorded, car.front_point_m, steps)
        figures[f"{length}_windows_left_out"] = windows.left_out
        known = chosen = windows
        if only_held_out:
            held = held_out(windows.iteration)
            known, chosen = windows.choose(~held), windows.choose(held)
        if formula is None:
            if not len(chosen) or not len(known):
                raise BadInput(
                    f"--traces: {len(chosen)} windows of a second to measure, {len(known)} to fit the formula to; "
                    f"accepted: at least one, with --held-out of two iterations or more"
                )
            # A second is what it is fitted to, like the car.
            formula = fit_formula(car, known)
        predictions = {
            "car": replay(car, chosen, threads=threads),
            "formula": formula.predict(car, chosen),
            "bicycle": bicycle(car, chosen),
        }
        figures[f"{length}_windows"] = counts(chosen)
        for model, predicted in predictions.items():
            figures.setdefault(model, {})[f"{length}_error_m"] = split(predicted, chosen)
    assert formula is not None
    headline = {f"{length}_error_m": figures["car"][f"{length}_error_m"]["all"] for length in LENGTHS}
    return {**headline, **figures, "formula_values": formula._asdict(), "wanted_one_second_m": WANTED_M}


def counts(windows: Windows) -> dict[str, int]:
    """Return how many windows there are, under way and from a standing start."""
    standing = int(windows.standing.sum())
    return {"all": len(windows), "under_way": len(windows) - standing, "standing": standing}


def split(predicted: Floats, windows: Windows) -> dict[str, float | None]:
    """Return the median error at the end of the windows: of all, under way, and from a standing start."""
    off = errors(predicted, windows).distance_m[:, -1]
    parts = {"all": np.full(len(off), True), "under_way": ~windows.standing, "standing": windows.standing}
    return {part: float(np.median(off[of])) if of.any() else None for part, of in parts.items()}


def show(figures: dict[str, Any]) -> str:
    """Return the figures as a table."""
    head = ("median error (m)", *MODELS, "windows")
    rows = [
        (
            f"{length.replace('_', ' ')}, {part.replace('_', ' ')}",
            *(number(figures[model][f"{length}_error_m"][part], 3) for model in MODELS),
            number(figures[f"{length}_windows"][part]),
        )
        for length in LENGTHS
        for part in ("all", "under_way", "standing")
    ]
    left_out = ", ".join(
        f"{figures[f'{length}_windows_left_out']} of {length.replace('_', ' ')}" for length in LENGTHS
    )
    return f"{table(head, rows)}\nleft out, since the car was paused or put elsewhere: windows {left_out}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and draw."""
    parser = benchmark_parser("fidelity", __doc__, None)
    parser.add_argument("--traces", type=Path, required=True, help="a folder of recorded drives, or one file")
    parser.add_argument(
        "--held-out", action="store_true", help="only the iterations that calibrate does not fit to"
    )
    parser.add_argument("--car", default="deepracer", help="the simulated car (an option of conf/car)")
    parser.add_argument("--threads", type=int, default=0, help="physics threads; 0: one per core")
    parser.add_argument(
        "--figures", type=Path, help="also draw the figures of docs/fidelity.md into this folder"
    )
    options = parser.parse_args(arguments)
    try:
        car = car_named(options.car)
        recording = read_recording(options.traces)
        for problem in recording.problems:
            print(problem, file=sys.stderr)
        recorded = recording.steps
        figures = measure(car, recorded, options.held_out, options.threads)
    except (BadInput, RunFailed) as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print(show(figures))
    write_json(options.json, {**figures, "held_out": options.held_out, "car_name": options.car})
    if options.figures is not None:
        from benchmarks.fidelity_figures import draw

        for path in draw(car, recorded, options.figures):
            print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
