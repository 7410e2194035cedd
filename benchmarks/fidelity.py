"""How far the simulated car is from recorded cars that were sent the same actions.

    python -m benchmarks.fidelity --traces PATH ... [--leave-one-out] [--car NAME] [--json FILE] [--figures DIR]

Takes the folders, files and archives that `deepracer-exp analyze` reads, of any generation; each is measured with the
car of its version. With --leave-one-out it is measured with a car that is fitted to the other recordings of its
version alone, which takes some minutes. docs/measured/fidelity.md explains the measure.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.calibrate import LEAST_WINDOWS, PARAMETERS, Fit, fit
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
_FITTED_TO = 600
"""Windows to which cars, observers and formulas are fitted, at most."""
_EVALUATIONS = 12
_BEGIN = {4: "deepracer_v6", 5: "deepracer_v4", 6: "deepracer_v4"}
"""Where a fit with a recording left out begins: the car of another version, which has not seen the recording."""
_FIT_EVALUATIONS = 30


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
    """What predicts a recording."""

    name: str
    """Of the car."""
    fitted: Fit
    """The car with an observer."""
    formula: Formula

    def predict(self, windows: Windows) -> dict[str, Floats]:
        """Return the poses that each of `MODELS` predicts, (M, steps, 3)."""
        car, observer = self.fitted.car, self.fitted.observer
        return {
            "car": replay(car, windows, observer),
            "formula": self.formula.predict(car, windows),
            "bicycle": bicycle(car, windows),
        }


Parts = Sequence[tuple[Recorded, Measured]]
"""Recordings of one version, each with what predicts it."""


def prepare(name: str, recorded: Sequence[Recorded]) -> Measured:
    """Fit an observer for the car, and the formula, to the recordings.

    Raises:
        BadInput: the recordings have no window.
    """
    car, some = car_named(name), _known(recorded)
    return Measured(name, fit(car, some, (), _EVALUATIONS, OBSERVER), fit_formula(car, some))


def prepare_without(version: int, left_out: Recorded, recorded: Sequence[Recorded]) -> Measured:
    """Fit a car with its observer, and the formula, to all recordings of a version but one.

    Raises:
        BadInput: the others have too few windows.
    """
    some = _known([one for one in recorded if one is not left_out])
    if len(some) < LEAST_WINDOWS:
        raise BadInput(
            f"--leave-one-out: without {left_out.name} there are {len(some)} windows of version {version} to fit to; "
            f"accepted: at least {LEAST_WINDOWS}"
        )
    begin = fit(car_named(_BEGIN[version]), some, (), _EVALUATIONS, OBSERVER)
    fitted = fit(begin.car, some, PARAMETERS, _FIT_EVALUATIONS, begin.observer)
    return Measured(f"fitted without {left_out.name}", fitted, fit_formula(begin.car, some))


def _known(recorded: Sequence[Recorded]) -> Windows:
    """Return the windows that are fitted to."""
    known = join([one.windows["one_second"] for one in recorded])
    if not len(known):
        raise BadInput(
            f"--traces: {', '.join(one.name for one in recorded)}: no window of a second; accepted: one"
        )
    return sample(known, _FITTED_TO, 0)


def measure(parts: Parts) -> dict[str, Any]:
    """Return the median errors on recordings of one version together."""
    bands: dict[str, dict[str, Any]] = {band: {} for band in (*BANDS, "all")}
    for length in LENGTHS:
        windows = join([one.windows[length] for one, _ in parts])
        predicted = [measured.predict(one.windows[length]) for one, measured in parts]
        for model in MODELS:
            paths = np.concatenate([of[model] for of in predicted])
            off = by_band(errors(paths, windows).distance_m[:, -1], windows)
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


def show(version: int, car: str, figures: dict[str, Any]) -> str:
    """Return the figures of one version as a table."""
    head = (f"version {version}, car={car}: median error (m)", *MODELS, "interval of the car", "windows")
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


def show_recording(name: str, figures: dict[str, Any]) -> str:
    """Return the figures of one recording as a line: errors after a second by band."""
    bands = (
        f"{band} {number(of['one_second_error_m'], 3)} ({of['windows']})"
        for band, of in figures["bands"].items()
        if of["windows"]
    )
    return f"{name}: {', '.join(bands)}"


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and draw."""
    parser = benchmark_parser("fidelity", __doc__, None)
    parser.add_argument(
        "--traces", type=Path, nargs="+", required=True, help="folders, files or archives of recorded drives"
    )
    parser.add_argument(
        "--leave-one-out", action="store_true", help="predict each recording with a car fitted to the others"
    )
    parser.add_argument("--car", help="one simulated car for all (an option of conf/car)")
    parser.add_argument(
        "--figures", type=Path, help="also draw the figures of docs/measured/fidelity.md into this folder"
    )
    options = parser.parse_args(arguments)
    if options.car is not None:
        car_named(options.car)
    if options.car is not None and options.leave_one_out:
        raise BadInput("--leave-one-out --car: accepted: one of the two, since cars are fitted")
    recorded = read_recorded(options.traces)
    versions: dict[str, Any] = {}
    drawn: list[tuple[int, list[tuple[Recorded, Fit]]]] = []
    for one in recorded:
        print(describe(one), flush=True)
    for version in sorted({one.version for one in recorded}):
        mine = [one for one in recorded if one.version == version]
        if options.leave_one_out:
            parts = [(one, prepare_without(version, one, mine)) for one in mine]
        else:
            measured = prepare(options.car or f"deepracer_v{version}", mine)
            parts = [(one, measured) for one in mine]
        name = "fitted without the recording" if options.leave_one_out else measured.name
        figures = measure(parts)
        print(f"\n{show(version, name, figures)}", flush=True)
        versions[str(version)] = {
            "car": name,
            **figures,
            "recordings": {
                one.name: {
                    "version_stated": one.stated,
                    "windows_left_out": one.windows["one_second"].left_out,
                    "car": {p.key: getattr(measured.fitted.car, p.key) for p in PARAMETERS},
                    "observer": measured.fitted.observer._asdict(),
                    "formula_values": measured.formula._asdict(),
                    **measure([(one, measured)]),
                }
                for one, measured in parts
            },
        }
        for one in mine:
            print(f"  {show_recording(one.name, versions[str(version)]['recordings'][one.name])}", flush=True)
        drawn.append((version, [(one, measured.fitted) for one, measured in parts]))
    write_json(options.json, {"versions": versions, "leave_one_out": options.leave_one_out})
    if options.figures is not None:
        from benchmarks.fidelity_figures import draw

        for path in draw(drawn, options.figures):
            print(path)


if __name__ == "__main__":
    sys.exit(main())
