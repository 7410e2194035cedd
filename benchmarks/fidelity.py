"""How far the simulated car is from recorded cars that were sent the same actions.

    python -m benchmarks.fidelity --traces DIR [--held-out] [--car NAME] [--json FILE] [--figures DIR]

Takes the traces or logs of any generation. docs/fidelity.md explains the measure.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.calibrate import FIT_STEPS, REPORT_STEPS, car_named, held_out
from benchmarks.replay import Windows, cut_windows, errors, replay
from benchmarks.report import number, table, write_json
from benchmarks.simple_cars import bicycle, fit_formula
from deepracer_exp.config.car import CarConfig
from deepracer_exp.deepracer.recording_reader import read_recording
from deepracer_exp.errors import BadInput, RunFailed

Floats = NDArray[np.float64]
WANTED_M = 0.06
LENGTHS = {"one_second": FIT_STEPS, "three_second": REPORT_STEPS}
MODELS = ("car", "formula", "bicycle")


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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, prog="benchmarks.fidelity"
    )
    parser.add_argument("--traces", type=Path, required=True, help="a folder of recorded drives, or one file")
    parser.add_argument(
        "--held-out", action="store_true", help="only the iterations that calibrate does not fit to"
    )
    parser.add_argument("--car", default="deepracer", help="the simulated car (an option of conf/car)")
    parser.add_argument("--threads", type=int, default=0, help="physics threads; 0: one per core")
    parser.add_argument("--json", type=Path, help="also write the figures as JSON to this file")
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
