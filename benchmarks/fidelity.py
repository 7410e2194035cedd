"""How far the simulated car is from recorded cars that were sent the same actions.

    python -m benchmarks.fidelity --traces PATH ... [--held-out] [--car NAME] [--json FILE] [--figures DIR]

Takes the folders, files and archives that `deepracer-exp analyze` reads, of any generation; each is measured with the
car of its version. docs/fidelity.md explains the measure.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.calibrate import LEAST_WINDOWS, Fit, fit
from benchmarks.recorded import (
    BANDS,
    LENGTHS,
    Recorded,
    by_band,
    car_named,
    describe,
    join,
    read_recorded,
    sample,
)
from benchmarks.replay import OBSERVER, WARM_UP_STEPS, Windows, errors, replay
from benchmarks.report import benchmark_parser, number, table, with_exit_code, write_json
from deepracer_exp.config.car import CarConfig
from deepracer_exp.errors import BadInput

Floats = NDArray[np.float64]
MODELS = ("car", "formula", "bicycle")
_FITTED_TO = 1500
"""Windows to which observer and formula are fitted, at most."""
_EVALUATIONS = 12


def bicycle(car: CarConfig, windows: Windows) -> Floats:
    """Predict with the kinematic bicycle, commanded speed and steering reached at once.

    Returns:
        x_m, y_m and yaw_rad after each step, (M, steps, 3).
    """
    ratio = -car.rear_axle_x_m / car.wheelbase_m
    x, y, yaw = windows.start.T
    driven = np.empty_like(windows.truth)
    for step in range(windows.steps):
        speed, steering = windows.action[:, WARM_UP_STEPS + step].T
        period = windows.duration_s[:, WARM_UP_STEPS + step]
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
        x, y, yaw = windows.pose[:, 0].T
        speed, rate = np.zeros(len(windows)), np.zeros(len(windows))
        driven = np.empty_like(windows.truth)
        for step in range(windows.action.shape[1]):
            known, period = step >= windows.first, windows.duration_s[:, step]
            keep_speed, keep_rate = np.exp(-period / self.speed_lag_s), np.exp(-period / self.rate_lag_s)
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


class Measured(NamedTuple):
    """What predicts the recordings of one version."""

    name: str
    """Of the car."""
    fitted: Fit
    """The car with an observer fitted to the part that is not held out."""
    formula: Formula
    """Fitted to the same part."""

    def predict(self, windows: Windows) -> dict[str, Floats]:
        """Return the poses that each of `MODELS` predicts, (M, steps, 3)."""
        car, observer = self.fitted.car, self.fitted.observer
        return {
            "car": replay(car, windows, observer),
            "formula": self.formula.predict(car, windows),
            "bicycle": bicycle(car, windows),
        }


def prepare(name: str, recorded: Sequence[Recorded]) -> Measured:
    """Fit an observer to the car and recordings, and the formula.

    Raises:
        BadInput: the recordings have no window.
    """
    car = car_named(name)
    known = join([one.part(False) for one in recorded])
    if len(known) < LEAST_WINDOWS:
        # One iteration only: there is no other part.
        known = join([one.windows["one_second"] for one in recorded])
    if not len(known):
        raise BadInput(
            f"--traces: {', '.join(one.name for one in recorded)}: no window of a second; accepted: one"
        )
    some = sample(known, _FITTED_TO, 0)
    return Measured(name, fit(car, some, (), _EVALUATIONS, OBSERVER), fit_formula(car, some))


def measure(measured: Measured, recorded: Sequence[Recorded], only_held_out: bool) -> dict[str, Any]:
    """Return the median errors on recordings of one version, together and one by one."""
    bands: dict[str, dict[str, Any]] = {band: {} for band in (*BANDS, "all")}
    for length in LENGTHS:
        windows = join([one.part(True, length) if only_held_out else one.windows[length] for one in recorded])
        for model, predicted in measured.predict(windows).items():
            off = by_band(errors(predicted, windows).distance_m[:, -1], windows)
            for band, median in off.items():
                figures = bands[band]
                if model == "car":
                    figures["windows" if length == "one_second" else f"{length}_windows"] = median.windows
                    figures.setdefault("episodes", median.episodes)
                else:
                    figures = figures.setdefault(model, {})
                figures[f"{length}_error_m"] = median.error_m
                figures[f"{length}_interval_m"] = median.interval_m
    return {"bands": bands}


def show(version: int, name: str, figures: dict[str, Any]) -> str:
    """Return the figures of one version as a table."""
    head = (f"version {version}, car={name}: median error (m)", *MODELS, "interval of the car", "windows")
    rows = []
    for length in LENGTHS:
        for band, of in figures["bands"].items():
            if of["windows"]:
                low, high = of[f"{length}_interval_m"] or (None, None)
                each = (of, of["formula"], of["bicycle"])
                rows.append(
                    (
                        f"{length.replace('_', ' ')}, {band}",
                        *(number(one[f"{length}_error_m"], 3) for one in each),
                        f"{number(low, 3)} to {number(high, 3)}",
                        number(of["windows" if length == "one_second" else f"{length}_windows"]),
                    )
                )
    return table(head, rows)


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and draw."""
    parser = benchmark_parser("fidelity", __doc__, None)
    parser.add_argument(
        "--traces", type=Path, nargs="+", required=True, help="folders, files or archives of recorded drives"
    )
    parser.add_argument(
        "--held-out", action="store_true", help="only the iterations that calibrate does not fit to"
    )
    parser.add_argument("--car", help="one simulated car for all (an option of conf/car)")
    parser.add_argument(
        "--figures", type=Path, help="also draw the figures of docs/fidelity.md into this folder"
    )
    options = parser.parse_args(arguments)
    if options.car is not None:
        car_named(options.car)
    recorded = read_recorded(options.traces)
    versions, drawn = {}, []
    for one in recorded:
        print(describe(one))
    for version in sorted({one.version for one in recorded}):
        mine = [one for one in recorded if one.version == version]
        measured = prepare(options.car or f"deepracer_v{version}", mine)
        figures = measure(measured, mine, options.held_out)
        print(f"\n{show(version, measured.name, figures)}", flush=True)
        versions[str(version)] = {
            "car": measured.name,
            "observer": measured.fitted.observer._asdict(),
            "formula_values": measured.formula._asdict(),
            **figures,
            "recordings": {
                one.name: {
                    "version_stated": one.stated,
                    "windows_left_out": one.windows["one_second"].left_out,
                    **measure(measured, [one], options.held_out),
                }
                for one in mine
            },
        }
        drawn.append((version, measured, mine))
    write_json(options.json, {"versions": versions, "held_out": options.held_out})
    if options.figures is not None:
        from benchmarks.fidelity_figures import draw

        for path in draw(drawn, options.figures):
            print(path)


if __name__ == "__main__":
    sys.exit(main())
