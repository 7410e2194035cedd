"""Fit the simulated car to recorded drives.

    python -m benchmarks.calibrate --traces PATH ... [--car NAME] [--output FILE.yaml]

Takes the folders, files and archives that `deepracer-exp analyze` reads, and reports the errors on what the car is
fitted to. How well such a car predicts a recording that it was not fitted to says `benchmarks.fidelity
--leave-one-out`. docs/measured/fidelity.md explains the measure.
"""

import dataclasses
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.recorded import (
    BANDS,
    LENGTHS,
    Median,
    Recorded,
    by_band,
    car_named,
    describe,
    join,
    mean_speed_mps,
    read_recorded,
    sample,
)
from benchmarks.replay import OBSERVER, Observer, Windows, errors, replay
from benchmarks.report import benchmark_parser, number, table, with_exit_code
from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.options import find
from deepracer_exp.errors import BadInput

Floats = NDArray[np.float64]

LEAST_WINDOWS = 20
_FITTED_AT = (4, 9, 14)
"""After a third, two thirds and the whole of a second."""
_POSITION_SCALE_M, _POSITION_SCALE_S = 0.02, 0.006
"""Errors count in shares of the first and of the second times the mean commanded speed: they grow with it."""
_HEADING_ARM_M = 0.1
"""A radian of heading counts as much as this distance."""
_BLOWN_UP = 200.0
_PROBE = 0.1
"""Derivatives are differences over this many steps of a parameter."""
_UNDETERMINED = 0.5
"""Least share of what is known of a parameter that has to come from the recordings."""


class Parameter(NamedTuple):
    """A number that is fitted: a key of the car, or a gain of the observer."""

    key: str
    step: float
    """A change that is felt: of the value, or of its logarithm."""
    logarithmic: bool
    low: float
    """What a car of this size can have at least."""
    high: float
    """And at most."""
    limits: tuple[float, float] = (-np.inf, np.inf)
    """Values beyond these have no meaning."""


PARAMETERS = (
    Parameter("com_z_m", 0.01, False, 0.001, 0.1, (0.001, 0.1)),
    Parameter("tyre_friction", 0.2, True, 0.1, 2.0),
    Parameter("front_tyre_along_ns_per_m", 0.3, True, 2.0, 3000.0),
    Parameter("rear_tyre_along_ns_per_m", 0.3, True, 2.0, 3000.0),
    Parameter("front_tyre_across_ns_per_m", 0.3, True, 2.0, 3000.0),
    Parameter("rear_tyre_across_ns_per_m", 0.3, True, 2.0, 3000.0),
    Parameter("drive_radius_m", 0.03, True, 0.02, 0.05),
    Parameter("front_motor_gain_nms", 0.4, True, 1e-4, 3.0),
    Parameter("rear_motor_gain_nms", 0.4, True, 1e-4, 3.0),
    Parameter("motor_torque_nm", 0.2, True, 0.01, 3.0),
    Parameter("speed_delay_s", 0.01, False, 0.0, 0.066, (0.0, 0.066)),
    Parameter("steering_time_s", 0.4, True, 0.001, 2.0),
    Parameter("steering_kick", 0.15, False, -0.5, 0.95, (-0.9, 0.95)),
    Parameter("steering_delay_s", 0.01, False, 0.0, 0.066, (0.0, 0.066)),
    Parameter("steering_trim_deg", 0.5, False, -5.0, 5.0),
)
"""Masses, inertias and lengths are the URDF's. Bounds: rubber grips with 0.1 (wet ice) to 2 (a racing tyre); wheels'
radius is 0.036 m; a delay is less than a control period."""

GAINS = tuple(
    Parameter(key, step, False, -np.inf, np.inf)
    for key, step in zip(Observer._fields, (0.1, 0.15, 1.0, 0.2, 0.3, 0.1), strict=True)
)


class Fit(NamedTuple):
    """A car, with the gains by which it is led along a recording."""

    car: CarConfig
    observer: Observer
    undetermined: tuple[str, ...] = ()
    """Parameters that the recordings do not determine; they keep their first values."""


def fit(
    car: CarConfig,
    windows: Windows,
    parameters: Sequence[Parameter] = PARAMETERS,
    evaluations: int = 25,
    observer: Observer = OBSERVER,
) -> Fit:
    """Return the car and observer that predict the windows best.

    A weak prior holds every parameter around where it begins: a step away counts as much as an error of 3 to 4 cm at
    one of the three points of time of one window. A parameter for which the recordings say less than that is set back,
    and the others are fitted again.

    Args:
        car: where to begin; what is not fitted stays.
        windows: what to predict.
        parameters: which keys of the car to fit; none: only the observer.
        evaluations: steps of the solver, at most, each of which drives every window once for each parameter and once
            more.
        observer: where its gains begin.
    """
    parameters = list(parameters)
    found, known = _solve(car, observer, windows, parameters, evaluations, Fit(car, observer))
    undetermined: list[str] = []
    while parameters and min(known) < _UNDETERMINED:
        least = parameters.pop(int(np.argmin(known)))
        undetermined.append(least.key)
        begin = dataclasses.replace(found.car, **{least.key: getattr(car, least.key)})
        found, known = _solve(car, observer, windows, parameters, evaluations, Fit(begin, found.observer))
    return found._replace(undetermined=tuple(undetermined))


def _solve(
    car: CarConfig,
    observer: Observer,
    windows: Windows,
    parameters: Sequence[Parameter],
    evaluations: int,
    begin: Fit,
) -> tuple[Fit, list[float]]:
    """Fit from `begin` with the prior around the given car; return also how well each parameter is known, 0 to 1."""
    count = len(parameters)
    every = (*parameters, *GAINS)
    centre = np.array([_to_scale(p, _value(p.key, car, observer)) for p in every])
    start = np.array([_to_scale(p, _value(p.key, begin.car, begin.observer)) for p in every])
    low, high = (np.array([p.limits[side] / p.step for p in every]) for side in (0, 1))

    def driven(place: Floats) -> tuple[CarConfig, Observer]:
        values = [_from_scale(p, one) for p, one in zip(every, place, strict=True)]
        chosen: dict[str, Any] = {p.key: value for p, value in zip(parameters, values, strict=False)}
        return dataclasses.replace(begin.car, **chosen), Observer(*values[count:])

    def residuals(place: Floats) -> Floats:
        return np.concatenate([_residuals(*driven(place), windows), place - centre])

    def jacobian(place: Floats) -> Floats:
        base = residuals(place)
        columns = []
        for at in range(len(place)):
            probed = place.copy()
            probed[at] += _PROBE if place[at] + _PROBE < high[at] else -_PROBE
            columns.append((residuals(probed) - base) / (probed[at] - place[at]))
        return np.stack(columns, axis=1)

    solved = least_squares(
        residuals,
        np.clip(start, low, high),
        jacobian,
        bounds=(low, high),
        loss="soft_l1",
        max_nfev=evaluations,
        ftol=3e-5,
        xtol=1e-4,
    )
    prior = len(solved.fun) - len(every) + np.arange(len(every))
    variance = np.diag(np.linalg.inv(solved.jac.T @ solved.jac))
    known = 1.0 - variance * solved.jac[prior, np.arange(len(every))] ** 2
    return Fit(*driven(solved.x)), [float(one) for one in known[:count]]


def _value(key: str, car: CarConfig, observer: Observer) -> float:
    return float(getattr(observer if key in Observer._fields else car, key))


def _to_scale(parameter: Parameter, value: float) -> float:
    return float(np.log(value) if parameter.logarithmic else value) / parameter.step


def _from_scale(parameter: Parameter, value: float) -> float:
    plain = value * parameter.step
    return float(np.exp(plain)) if parameter.logarithmic else float(np.clip(plain, *parameter.limits))


def _residuals(car: CarConfig, observer: Observer, windows: Windows) -> Floats:
    off, at = errors(replay(car, windows, observer), windows), np.array(_FITTED_AT)
    parts = [off.x_m[:, at], off.y_m[:, at], _HEADING_ARM_M * off.yaw_rad[:, at]]
    scale_m = _POSITION_SCALE_M + _POSITION_SCALE_S * mean_speed_mps(windows)
    found = np.concatenate([(part / scale_m[:, None]).ravel() for part in parts])
    limited: Floats = np.clip(np.nan_to_num(found, nan=_BLOWN_UP), -_BLOWN_UP, _BLOWN_UP)
    return limited


def write_car(car: CarConfig, base: str, fitted: Sequence[str], path: Path, note: str) -> None:
    """Write an option file that builds on the option `car=<base>` and has the fitted values, with its comments."""
    lines = [f"# {note}", "defaults:", f"  - {base}", "", "# The car's name.", f"name: {path.stem}", ""]
    for key in fitted:
        lines += [*_comment(key, base), f"{key}: {getattr(car, key):.4g}"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _comment(key: str, option: str) -> list[str]:
    """Return the comment above a key in the file of an option, or in the one that it builds on."""
    text = Path(find(f"car/{option}.yaml")).read_text(encoding="utf-8")
    above = re.search(rf"(?m)((?:^#.*\n)+)^{key}:", text)
    if above is not None:
        return above[1].splitlines()
    below = (yaml.safe_load(text) or {}).get("defaults", [])
    return _comment(key, below[0]) if below else []


def parameter_table(before: CarConfig, fitted: Fit, parameters: Sequence[Parameter]) -> str:
    """Return the parameters before and after the fit as text."""
    rows = [
        (
            p.key,
            f"{getattr(before, p.key):.4g}",
            "not determined" if p.key in fitted.undetermined else f"{getattr(fitted.car, p.key):.4g}",
        )
        for p in parameters
    ]
    return table(("parameter", "before", "after"), rows)


def unphysical(car: CarConfig, parameters: Sequence[Parameter]) -> list[str]:
    """Return a line for each fitted value that no car of this size has."""
    found = []
    for p in parameters:
        value = float(getattr(car, p.key))
        if not p.low <= value <= p.high:
            side, bound = ("below", p.low) if value < p.low else ("above", p.high)
            found.append(
                f"unphysical: {p.key} {value:.4g} is {side} {bound:g}; the recordings do not determine it, or show "
                "what this model of the car cannot do"
            )
    return found


def interval(median: Median) -> str:
    """Return a median error with its interval for a table."""
    if median.interval_m is None:
        return "-"
    return f"{number(median.error_m, 3)} ({median.interval_m[0]:.3f} to {median.interval_m[1]:.3f})"


def error_table(before: Fit, after: Fit, parts: dict[str, Windows]) -> str:
    """Return the median errors at the ends of windows by part and band of speed."""
    rows = []
    for part, windows in parts.items():
        off = [
            by_band(errors(replay(one.car, windows, one.observer), windows).distance_m[:, -1], windows)
            for one in (before, after)
        ]
        for band in (*BANDS, "all"):
            count = off[0][band].windows
            if count:
                rows.append((f"{part}, {band}", str(count), *(interval(one[band]) for one in off)))
    return table(("median error (m) and 95% interval", "windows", "before", "after"), rows)


def _starting_car(name: str | None, recorded: Sequence[Recorded]) -> str:
    """Return the name of the car to begin with.

    Raises:
        BadInput: the recordings are of several versions.
    """
    if name is not None:
        return name
    versions = sorted({one.version for one in recorded})
    if len(versions) > 1:
        several = ", ".join(f"{one.name} of version {one.version}" for one in recorded)
        raise BadInput(
            f"--traces: {several}; accepted: recordings of one version, or --car NAME to begin with"
        )
    return f"deepracer_v{versions[0]}"


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Fit and report.

    Raises:
        BadInput: nothing to fit to, or nowhere to write the car.
    """
    parser = benchmark_parser("calibrate", __doc__, None, json=False)
    parser.add_argument(
        "--traces", type=Path, nargs="+", required=True, help="folders, files or archives of recorded drives"
    )
    parser.add_argument(
        "--car", help="the car to begin with (an option of conf/car); else that of the version"
    )
    parser.add_argument("--output", type=Path, help="write the fitted car as an option file to this path")
    parser.add_argument(
        "--evaluations", type=int, default=25, help="steps of the least squares solver, at most"
    )
    parser.add_argument("--windows", type=int, default=3000, help="windows to fit to, at most")
    parser.add_argument("--seed", type=int, default=0, help="which windows are taken")
    options = parser.parse_args(arguments)
    if options.evaluations < 1:
        raise BadInput(f"--evaluations {options.evaluations}: accepted: 1 or more")
    if options.windows < LEAST_WINDOWS:
        raise BadInput(f"--windows {options.windows}: accepted: {LEAST_WINDOWS} or more")
    if options.car is not None:
        car_named(options.car)
    if options.output is not None:
        _require_writable(options.output)
    recorded = read_recorded(options.traces)
    name = _starting_car(options.car, recorded)
    car = car_named(name)
    known = join([one.windows["one_second"] for one in recorded])
    if len(known) < LEAST_WINDOWS:
        raise BadInput(
            f"--traces {' '.join(map(str, options.traces))}: {len(known)} windows of a second; accepted: at least "
            f"{LEAST_WINDOWS}"
        )
    for one in recorded:
        print(describe(one))
    some = sample(known, options.windows, options.seed)
    print(f"fitting car={name} to {len(some)} of {len(known)} windows", flush=True)
    before = fit(car, some, (), options.evaluations)
    found = fit(car, some, PARAMETERS, options.evaluations, before.observer)
    print(f"\n{parameter_table(car, found, PARAMETERS)}\n")
    for length in LENGTHS:
        windows = join([one.windows[length] for one in recorded])
        after = f"after {length.replace('_', ' ')}"
        print(f"{error_table(before, found, {after: windows})}\n")
    print(error_table(before, found, {one.name: one.windows["one_second"] for one in recorded}))
    if found.undetermined:
        print(f"not determined by the recordings, and as in car={name}: {', '.join(found.undetermined)}")
    fitted = [p for p in PARAMETERS if p.key not in found.undetermined]
    for line in unphysical(found.car, fitted):
        print(line)
    if options.output is not None:
        note = f"Fitted by benchmarks.calibrate to {', '.join(one.name for one in recorded)}."
        write_car(found.car, name, [p.key for p in fitted], options.output, note)
        print(f"\nwritten: {options.output}")


def _require_writable(path: Path) -> None:
    try:
        with path.open("a", encoding="utf-8"):
            pass
        if path.stat().st_size == 0:
            path.unlink()
    except OSError as error:
        raise BadInput(f"--output {path}: cannot be written: {error.strerror}") from error


if __name__ == "__main__":
    sys.exit(main())
