"""Fit the simulated car to recorded drives.

    python -m benchmarks.calibrate --traces DIR [--car NAME] [--output FILE.yaml]

Every fourth iteration of the recordings is held out: the car is fitted to a sample of windows of the others and its
errors are reported for both. docs/fidelity.md says what was found and what the figures mean.
"""

import argparse
import dataclasses
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.replay import Windows, cut_windows
from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.options import find
from deepracer_exp.deepracer.recording_reader import read_recording
from deepracer_exp.errors import BadInput, RunFailed

from .replay import Errors, errors, replay
from .report import number, table

Floats = NDArray[np.float64]

FIT_STEPS = 15
REPORT_STEPS = 45
_LEAST_WINDOWS = 20
_FITTED_AT = (4, 9, 14)
"""After a third, two thirds and the whole of a second."""
_POSITION_SCALE_M = 0.03
_HEADING_ARM_M = 0.1
"""A radian of heading counts as much as this distance."""
_BLOWN_UP = 50.0
_PROBE = 0.15
"""Derivatives are differences over this share of a parameter's step: less is lost in the solver's tolerance."""


class Parameter(NamedTuple):
    """A key of the car that is fitted."""

    key: str
    step: float
    """A change that is felt: of the value, or of its logarithm."""
    logarithmic: bool
    low: float
    """What a car of this size can have at least."""
    high: float
    """And at most."""


PARAMETERS = (
    Parameter("tyre_friction", 0.2, True, 0.1, 1.5),
    Parameter("front_slip_time_s", 0.2, True, 0.0267, 1.0),
    Parameter("rear_slip_time_s", 0.2, True, 0.0267, 1.0),
    Parameter("drive_radius_m", 0.2, True, 0.02, 0.05),
    Parameter("front_motor_gain_nms", 0.2, True, 1e-4, 1.0),
    Parameter("rear_motor_gain_nms", 0.2, True, 1e-4, 1.0),
    Parameter("motor_torque_nm", 0.2, True, 0.01, 2.0),
    Parameter("servo_damping_nms", 0.2, True, 0.02, 4.0),
    Parameter("servo_kick", 0.05, False, 0.0, 0.95),
    Parameter("steering_trim_deg", 1.0, False, -5.0, 5.0),
)
"""Masses, inertias and lengths are the URDF's. Bounds: rubber grips with 0.1 (wet ice) to 1.5 (a racing tyre); slip
takes two physics steps or more; the wheels' radius is 0.036 m; the servo's time constant, damping over its gain of 2,
is 0.01 to 2 s."""


def held_out(iteration: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Say of each window whether it belongs to an iteration that is not fitted to: every fourth, or the last of few."""
    iterations = np.unique(iteration)
    held: NDArray[np.bool_] = np.isin(iteration, iterations[3::4] if len(iterations) > 3 else iterations[-1:])
    return held


def fit(
    car: CarConfig,
    windows: Windows,
    parameters: Sequence[Parameter],
    evaluations: int,
    report: Callable[[float], None] = lambda cost: None,
) -> CarConfig:
    """Return the car with the parameters that predict the windows best.

    Args:
        car: where to begin; what is not fitted stays.
        windows: what to predict.
        parameters: which keys of the car to fit.
        evaluations: at most this many steps of scipy's least_squares, each of which drives every window once for each
            parameter and once more.
        report: called with the cost after every improvement.

    Raises:
        RunFailed: the physics of the car to begin with blew up.
    """
    begin = np.array([_to_scale(p, getattr(car, p.key)) for p in parameters])
    best = np.inf

    def driven(place: Floats) -> CarConfig:
        # least_squares takes steps relative to the values: 1 is where it begins.
        values = begin + (place - 1.0)
        chosen: dict[str, Any] = {
            p.key: _from_scale(p, value) for p, value in zip(parameters, values, strict=True)
        }
        return dataclasses.replace(car, **chosen)

    def residuals(place: Floats) -> Floats:
        nonlocal best
        try:
            found = _residuals(errors(replay(driven(place), windows), windows))
        except (RunFailed, ValueError):
            return np.full(3 * len(_FITTED_AT) * len(windows), _BLOWN_UP)
        cost = float(np.sum(np.sqrt(1.0 + found**2) - 1.0))
        if cost < best:
            best = cost
            report(cost)
        return found

    _residuals(errors(replay(car, windows), windows))
    found = least_squares(
        residuals, np.ones(len(parameters)), loss="soft_l1", diff_step=_PROBE, max_nfev=evaluations
    )
    return driven(found.x)


def _to_scale(parameter: Parameter, value: float) -> float:
    return (np.log(value) if parameter.logarithmic else value) / parameter.step


def _from_scale(parameter: Parameter, value: float) -> float:
    plain = value * parameter.step
    return float(np.exp(plain) if parameter.logarithmic else plain)


def _residuals(off: Errors) -> Floats:
    at = np.array(_FITTED_AT)
    parts = [off.x_m[:, at], off.y_m[:, at], _HEADING_ARM_M * off.yaw_rad[:, at]]
    return np.concatenate([part.ravel() for part in parts]) / _POSITION_SCALE_M


def write_car(car: CarConfig, name: str, fitted: Sequence[Parameter], path: Path) -> None:
    """Write the option `car=<name>` with the fitted values in place of its own, comments included."""
    text = Path(find(f"car/{name}.yaml")).read_text(encoding="utf-8")
    values = {p.key: f"{getattr(car, p.key):.5g}" for p in fitted} | {"name": path.stem}
    for key, value in values.items():
        text, replaced = re.subn(rf"(?m)^{key}: .*$", f"{key}: {value}", text)
        assert replaced == 1, key
    path.write_text(text, encoding="utf-8")


def parameter_table(before: CarConfig, after: CarConfig, parameters: Sequence[Parameter]) -> str:
    """Return what became of the parameters as text."""
    rows = [(p.key, f"{getattr(before, p.key):.5g}", f"{getattr(after, p.key):.5g}") for p in parameters]
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


def error_table(before: CarConfig, after: CarConfig, recorded: Sequence[Windows]) -> str:
    """Return the median errors at the ends of windows of several lengths, on both parts of the recordings."""

    def median_error(car: CarConfig, some: Windows) -> float | None:
        return float(np.median(errors(replay(car, some), some).distance_m[:, -1])) if len(some) else None

    rows = []
    for windows in recorded:
        held = held_out(windows.iteration)
        for part, chosen in (("fitted iterations", ~held), ("held-out iterations", held)):
            some = windows.choose(chosen)
            name = f"{windows.steps * before.control_period_s:.0f} s, {part}"
            off = (number(median_error(car, some), 3) for car in (before, after))
            rows.append((name, str(len(some)), *off))
    return table(("error (m), median", "windows", "before", "after"), rows)


def car_named(name: str) -> CarConfig:
    """Return the car of an option of `conf/car/`.

    Raises:
        BadInput: there is none of that name.
    """
    return compose_experiment([f"car={name}"])[0].car


def run(options: argparse.Namespace) -> None:
    """Fit and report.

    Raises:
        BadInput: nothing to fit to, or nowhere to write the car.
    """
    car = car_named(options.car)
    if options.evaluations < 1:
        raise BadInput(f"--evaluations {options.evaluations}: accepted: 1 or more")
    if options.windows < _LEAST_WINDOWS:
        raise BadInput(f"--windows {options.windows}: accepted: {_LEAST_WINDOWS} or more")
    if options.output is not None:
        _require_writable(options.output)
    recording = read_recording(options.traces)
    for problem in recording.problems:
        print(problem, file=sys.stderr)
    recorded = recording.steps
    windows, long = (cut_windows(recorded, car.front_point_m, steps) for steps in (FIT_STEPS, REPORT_STEPS))
    if windows.left_out:
        print(
            f"{windows.left_out} windows of a second are left out: the car was paused or put elsewhere in them"
        )
    held = held_out(windows.iteration)
    for part, count in (("to fit to", (~held).sum()), ("to hold out", held.sum())):
        if count < _LEAST_WINDOWS:
            raise BadInput(
                f"{options.traces}: {count} windows of a second {part} in "
                f"{len(np.unique(windows.iteration))} iterations; accepted: at least {_LEAST_WINDOWS}, of two or more"
            )
    rng = np.random.default_rng(options.seed)
    known = np.flatnonzero(~held)
    sample = windows.choose(np.sort(rng.choice(known, min(options.windows, len(known)), replace=False)))
    print(f"fitting {len(PARAMETERS)} parameters to {len(sample)} of {len(known)} windows", flush=True)
    fitted = fit(
        car, sample, PARAMETERS, options.evaluations, lambda cost: print(f"cost {cost:.2f}", flush=True)
    )
    print(f"\n{parameter_table(car, fitted, PARAMETERS)}\n\n{error_table(car, fitted, (windows, long))}")
    for line in unphysical(fitted, PARAMETERS):
        print(line)
    if options.output is not None:
        write_car(fitted, options.car, PARAMETERS, options.output)
        print(f"\nwritten: {options.output}")


def _require_writable(path: Path) -> None:
    try:
        with path.open("a", encoding="utf-8"):
            pass
        if path.stat().st_size == 0:
            path.unlink()
    except OSError as error:
        raise BadInput(f"--output {path}: cannot be written: {error.strerror}") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Fit as the command line says; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="benchmarks.calibrate",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--traces", type=Path, required=True, help="a folder of recorded drives, or one file")
    parser.add_argument("--car", default="deepracer", help="the car to begin with (an option of conf/car)")
    parser.add_argument("--output", type=Path, help="write the fitted car as an option file to this path")
    parser.add_argument(
        "--evaluations", type=int, default=12, help="steps of the least squares solver, at most"
    )
    parser.add_argument("--windows", type=int, default=400, help="windows to fit to, at most")
    parser.add_argument("--seed", type=int, default=0, help="which windows are taken")
    try:
        run(parser.parse_args(arguments))
    except (BadInput, RunFailed) as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
