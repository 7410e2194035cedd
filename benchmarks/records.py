"""What trainings drive at their end, beside the fastest lap of their car and official records.

    python -m benchmarks.records [--seeds 5] [--tracks A,B,...] [--official] [--steps N] [--jobs 2] [--runs-dir DIR]
                                 [--json FILE] [OVERRIDE...]

For each track and seed, `deepracer-exp train experiment=fast_lap` trains for the recipe's own budget, or `--steps`,
as `benchmarks.longer` does, and its best checkpoint drives 64 fresh laps from starts all around the track, under usual
conditions. The lap of a seed is the mean of its complete laps, from standstill, by the service's clock. Beside it
stands the fastest lap of the car within the recipe's limits, from standstill at the start line, and its bound from
below (`deepracer-exp tracks NAME --fastest`). Tracks with official boards of time trials since March 2020 are trained
again, by `experiment=sliding_car` with the car of their newest board; `--official`: only these. A record there is the
fastest single lap of several in a row: beside it stands
the fastest lap of each seed in eight races of three laps in a row from the start line.

JSON has, in `tracks` and `official`, for each track `bound_s`, `fastest_s`, `fastest_over_bound`, the `laps_s` of the
seeds (null: none complete), their `median_s` and `best_s`, `median_over_fastest`, `completion`, the mean share of
complete laps, and `train_s`, the longest of the trainings; official ones `car`,
`record_s` and `flying_laps_s` of the seeds as well.
`--runs-dir DIR` leaves the runs in DIR and takes those that it, or `benchmarks.longer`, finished there: an interrupted
benchmark continues.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.setup import build_courses
from deepracer_exp.errors import BadInput
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.fastest.fastest_lap import Question, fastest_lap
from deepracer_exp.evaluation.results import USUAL
from deepracer_exp.tracks.boards import boards_of

from .all_tracks import TRACKS
from .command import at_once, read_summary, trained
from .fresh import Driven, drive, protocol, stored_policy
from .longer import training_overrides
from .report import benchmark_parser, median, number, percent, table, with_exit_code, write_json

_RECIPE, _OFFICIAL = "fast_lap", "sliding_car"
_RACES, _SEED = 8, 20_181_128


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


def fastest_in_a_row(run: Path) -> float | None:
    """Return the fastest lap, seconds, of a run's best policy in races of three laps in a row; None: none complete."""
    experiment, policy = stored_policy(run)
    config = protocol(
        *(
            "evaluation=three_trials",
            f"evaluation.trials={_RACES}",
            "evaluation.laps=3",
            "evaluation.starts=[0.0]",
        ),
        *("evaluation.held_out=null", f"evaluation.seed={_SEED}"),
    )
    times_s = Evaluator(experiment, config)(policy).on(USUAL).lap_times_s.tolist()
    return min(times_s, default=None)


def measure(
    places: Sequence[tuple[str, str | None]], options: argparse.Namespace, folder: Path
) -> list[dict[str, Any]]:
    """Train each track and car over all seeds, search for its fastest lap and let the policies drive.

    Args:
        places: track, and the car that replaces the recipe's own; None: its own.
    """
    overrides = [
        training_overrides(
            track,
            _RECIPE if car is None else _OFFICIAL,
            options.steps,
            [*([] if car is None else [f"car={car}"]), *options.overrides],
        )
        for track, car in places
    ]
    # All of them before the first training: one that cannot be composed costs nothing.
    experiments = [compose_experiment(words)[0] for words in overrides]
    names = [f"{track}-{_RECIPE}" if car is None else f"{track}-{_OFFICIAL}-{car}" for track, car in places]
    runs = at_once(
        options.jobs,
        [
            partial(trained, folder / f"{name}-{seed}", [*words, f"seed={seed}"])
            for name, words in zip(names, overrides, strict=True)
            for seed in range(options.seeds)
        ],
    )
    rows = []
    for index, (name, experiment) in enumerate(zip(names, experiments, strict=True)):
        (course,) = build_courses(experiment)
        fastest = fastest_lap(Question.of(experiment, course.tracks[0]))
        of_track = [run.resolve() for run in runs[index * options.seeds : (index + 1) * options.seeds]]
        driven = [drive(run, [None])[0] for run in of_track]
        train_s = max(read_summary(run)["wall_clock_s"] for run in of_track)
        row = {**figures(fastest.bound_s, fastest.lap_time_s, driven), "train_s": round(train_s, 1)}
        if places[index][1] is not None:
            row["flying_laps_s"] = [fastest_in_a_row(run) for run in of_track]
        rows.append(row)
        print(f"{name}: {rows[-1]}", flush=True)
    return rows


def benchmark(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Measure all tracks, then those with an official board again with the car of its era."""
    tracks = options.tracks.split(",")
    own = [] if options.official else tracks
    found: dict[str, Any] = {
        "tracks": dict(zip(own, measure([(track, None) for track in own], options, folder), strict=True))
    }
    newest = {track: boards_of(track)[-1] for track in tracks if boards_of(track)}
    official = measure([(track, board.car) for track, board in newest.items()], options, folder)
    found["official"] = {
        track: {**row, "car": board.car, "record_s": board.record_s}
        for (track, board), row in zip(newest.items(), official, strict=True)
    }
    return found


def show(rows: dict[str, dict[str, Any]]) -> str:
    """Return the figures of tracks as a table."""
    head = (
        *("track", "bound (s)", "fastest (s)", "above it", "median lap (s)", "above fastest", "best lap (s)"),
        *("complete", "training (s)", "flying lap (s): median", "best", "record (s)"),
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
                number(row["train_s"], 0),
                *(number(lap_s, 2) for lap_s in _flying(row)),
                number(row.get("record_s"), 2),
            )
            for name, row in rows.items()
        ],
    )


def _flying(row: dict[str, Any]) -> tuple[float | None, float | None]:
    """Return median and best of the flying laps of the seeds, s; a seed without one is slower than any."""
    times_s = row.get("flying_laps_s", [])
    complete = [lap_s for lap_s in times_s if lap_s is not None]
    middle = median(times_s) if 2 * len(complete) > len(times_s) else None
    return middle, min(complete, default=None)


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and store."""
    parser = benchmark_parser("records", __doc__)
    parser.add_argument("--seeds", type=int, default=5, help="trainings on each track (5)")
    parser.add_argument(
        "--steps", type=int, help="control steps of each training (default: the recipe's budget)"
    )
    parser.add_argument("--jobs", type=int, default=2, help="trainings at once")
    parser.add_argument(
        "--tracks", default=",".join(TRACKS), help="A,B,... (the 18 of benchmarks.all_tracks)"
    )
    parser.add_argument(
        "--official", action="store_true", help="only the cars and boards of the service's races"
    )
    parser.add_argument("--runs-dir", type=Path, help="folder of the runs; left out: they are not kept")
    options = parser.parse_args(arguments)
    if options.seeds < 1 or options.jobs < 1:
        raise BadInput("--seeds and --jobs: accepted: 1 or more")
    with tempfile.TemporaryDirectory() as temporary:
        found = benchmark(options, options.runs_dir or Path(temporary))
    if own := found["tracks"]:
        over = [row["fastest_over_bound"] for row in own.values()]
        found["mean_fastest_over_bound"] = round(sum(over) / len(over), 4)
        print(f"{show(own)}\n\nfastest lap above its bound, mean: {percent(sum(over) / len(over), 1)}\n")
    if found["official"]:
        print(f"with the car of the newest official board, beside its record:\n\n{show(found['official'])}")
    write_json(options.json, found)


if __name__ == "__main__":
    sys.exit(main())
