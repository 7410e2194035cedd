"""What `experiment=fast_lap` drives after a few minutes, beside the fastest lap of its car and official records.

    python -m benchmarks.records [--seeds 5] [--minutes 10] [--tracks A,B,...] [--runs-dir DIR] [--json FILE]
                                 [OVERRIDE...]

For each track and seed, `deepracer-exp train experiment=fast_lap` trains for so many minutes on this machine, one
training at a time, and its best checkpoint drives 64 fresh laps from starts all around the track, under usual
conditions. The lap of a seed is the mean of its complete laps, from standstill, by the service's clock. Beside it
stands the fastest lap of the car within the recipe's limits, from standstill at the start line, and its bound from
below (`deepracer-exp tracks NAME --fastest`). Tracks with official boards of time trials since March 2020 are trained
again with the car of their newest board.

JSON has, in `tracks` and `official`, for each track `bound_s`, `fastest_s`, `fastest_over_bound`, the `laps_s` of the
seeds (null: none complete), their `median_s` and `best_s`, `median_over_fastest`, and `completion`, the mean share of
complete laps; official ones `car` and `record_s` as well. `--runs-dir DIR` leaves the runs in DIR and takes those that
it finds finished there: an interrupted benchmark continues.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.setup import build_courses
from deepracer_exp.errors import BadInput
from deepracer_exp.fastest.lap import Question, fastest_lap
from deepracer_exp.tracks.boards import boards_of

from .all_tracks import TRACKS
from .command import trained
from .fresh import Driven, drive
from .report import benchmark_parser, median, number, percent, table, with_exit_code, write_json

_ALWAYS = ("experiment=fast_lap", "tracking=off", "report=false", "budget.env_steps=null")


def figures(bound_s: float, fastest_s: float, driven: Sequence[Driven]) -> dict[str, Any]:
    """Return the figures of a track, JSON types, from how the policy of each seed drove."""
    times = [one.lap_time_s for one in driven]
    complete = [time_s for time_s in times if time_s is not None]
    # A seed without a lap is slower than any.
    middle = None if 2 * len(complete) <= len(times) else median(times)
    return {
        "bound_s": round(bound_s, 3),
        "fastest_s": round(fastest_s, 3),
        "fastest_over_bound": round(fastest_s / bound_s - 1.0, 4),
        "laps_s": times,
        "median_s": middle,
        "best_s": min(complete, default=None),
        "median_over_fastest": None if middle is None else round(middle / fastest_s - 1.0, 4),
        "completion": round(sum(one.lap_share for one in driven) / len(driven), 4),
    }


def measure(track: str, car: Sequence[str], options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Search for the fastest lap, train each seed and let it drive."""
    words = [f"track={track}", *_ALWAYS, f"budget.minutes={options.minutes}", *car, *options.overrides]
    experiment, _ = compose_experiment(words)
    (course,) = build_courses(experiment)
    fastest = fastest_lap(Question.of(experiment, course.tracks[0]))
    name = "-".join([track, *(word.partition("=")[2] for word in car)])
    runs = [
        trained(folder / f"{name}-{seed}", [*words, f"seed={seed}"]).resolve()
        for seed in range(options.seeds)
    ]
    return figures(fastest.bound_s, fastest.lap_time_s, [drive(run, [None])[0] for run in runs])


def benchmark(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Measure all tracks, then those with an official board again with the car of its era."""
    tracks = options.tracks.split(",")
    found: dict[str, Any] = {"tracks": {track: measure(track, (), options, folder) for track in tracks}}
    newest = {track: boards_of(track)[-1] for track in tracks if boards_of(track)}
    found["official"] = {
        track: {
            **measure(track, (f"car={board.car}",), options, folder),
            "car": board.car,
            "record_s": board.record_s,
        }
        for track, board in newest.items()
    }
    over = [row["fastest_over_bound"] for row in found["tracks"].values()]
    found["mean_fastest_over_bound"] = round(sum(over) / len(over), 4)
    return found


def show(rows: dict[str, dict[str, Any]]) -> str:
    """Return the figures of tracks as a table."""
    head = (
        *("track", "bound (s)", "fastest (s)", "above it", "median lap (s)", "above fastest", "best lap (s)"),
        *("complete", "record (s)"),
    )
    return table(
        head,
        [
            (
                name,
                number(row["bound_s"], 2),
                number(row["fastest_s"], 2),
                percent(row["fastest_over_bound"], 1),
                number(row["median_s"], 2),
                percent(row["median_over_fastest"], 1),
                number(row["best_s"], 2),
                percent(row["completion"]),
                number(row.get("record_s"), 2),
            )
            for name, row in rows.items()
        ],
    )


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and store."""
    parser = benchmark_parser("records", __doc__)
    parser.add_argument("--seeds", type=int, default=5, help="trainings on each track (5)")
    parser.add_argument("--minutes", type=float, default=10.0, help="of each training (10)")
    parser.add_argument(
        "--tracks", default=",".join(TRACKS), help="A,B,... (the 18 of benchmarks.all_tracks)"
    )
    parser.add_argument("--runs-dir", type=Path, help="folder of the runs; left out: they are not kept")
    options = parser.parse_args(arguments)
    if options.seeds < 1 or not options.minutes > 0:
        raise BadInput("--seeds and --minutes: accepted: above 0")
    with tempfile.TemporaryDirectory() as temporary:
        found = benchmark(options, options.runs_dir or Path(temporary))
    print(show(found["tracks"]))
    if found["official"]:
        print(f"\nwith the car of the newest official board, beside its record:\n\n{show(found['official'])}")
    print(f"\nfastest lap above its bound, mean: {percent(found['mean_fastest_over_bound'], 1)}")
    write_json(options.json, found)


if __name__ == "__main__":
    sys.exit(main())
