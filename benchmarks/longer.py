"""Does a car become faster the longer it trains?

    python -m benchmarks.longer [--seeds 5] [--tracks A,B,...] [--recipes default,fast_lap] [--steps N] [--jobs 2]
                                [--runs-dir DIR] [--json FILE] [OVERRIDE...]

For each track, recipe and seed, `deepracer-exp train` runs the recipe with `stopping=none`, so that the curve is seen
to its end: `default` is the default experiment, any other name an option of conf/experiment. Its budget is the
recipe's own, or `--steps`. All cars of a run are in its process (`collector=in_process`), which gives the same run as
the recipe's own collector; `--jobs` runs train at once.

Every ten iterations a training evaluates the most probable actions of its policy on the usual conditions. Of the mean
time of the complete laps this takes the interquartile mean over seeds with its 95% bootstrap interval; a seed whose
policy completes no lap is slower than any. At the end the best checkpoint of each seed drives 64 fresh laps on usual
conditions and 64 on held-out ones. JSON has for each track and recipe, in lists a value an evaluation:

- `steps`, control steps over all cars; `laps_s` and `interval_s`, null where more than a quarter of the seeds completes
  no lap; `lap_share`, complete laps of those tried, mean over seeds;
- `held_out`: completion on held-out conditions, per cent of the lap, median over seeds;
- `best`: of the fresh laps of the best checkpoints, medians over seeds: `lap_s` (null: none in half of them),
  `completion` and `held_out`, per cent, with those of each seed;
- `worst_rise`: how far any evaluation after the first lap is above the fastest one before it, as a share; null where
  there is no lap at all, or none any more later;
- `bound_s`: the bound of a lap from standstill at the start line by a perfect driver of this car (`deepracer-exp
  tracks NAME --fastest` prints it), and how far laps are above it as a share: `over_bound` after 1.5 million steps,
  `over_bound_end` after all; null without a lap there, or where a training ends before.

`--runs-dir DIR` leaves the runs in DIR and takes those that it finds finished there: an interrupted benchmark
continues.
"""

import argparse
import math
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.setup import build_courses
from deepracer_exp.evaluation.fastest.fastest_lap import Question, fastest_lap
from deepracer_exp.reports.tables.evidence import Interval, iqm_band
from deepracer_exp.reports.tables.statistics import Values

from .command import at_once, read_metrics, trained
from .fresh import Driven, drive
from .report import benchmark_parser, median, number, percent, table, with_exit_code, write_json

TRACKS = ("reinvent_base", "reInvent2019_track", "Spain_track", "Oval_track", "Monaco")
RECIPES = ("default", "fast_lap")
EARLY_STEPS = 1_500_000
WANTED = {"worst_rise": 0.02, "over_bound": 0.09, "over_bound_end": 0.06}
"""At most."""
WANTED_HELD_OUT = 97.0
"""Per cent of the lap on held-out conditions, median over seeds of the best checkpoints, at least."""
_ALWAYS = ("stopping=none", "collector=in_process", "collector.threads=1", "tracking=off", "report=false")


def training_overrides(track: str, recipe: str, steps: int | None, overrides: Sequence[str]) -> list[str]:
    """Return the overrides of `deepracer-exp train` of all seeds."""
    experiment = [] if recipe == "default" else [f"experiment={recipe}"]
    budget = [] if steps is None else [f"budget.env_steps={steps}"]
    return [*experiment, f"track={track}", *_ALWAYS, *budget, *overrides]


def lap_bound_s(experiment: Experiment) -> float:
    """Return the bound of an experiment's fastest lap on its track; the search takes a minute, and is kept."""
    (course,) = build_courses(experiment)
    return fastest_lap(Question.of(experiment, course.tracks[0])).bound_s


def evaluations(runs: Sequence[Path]) -> tuple[list[int], Values, Values, Values]:
    """Return the evaluations of runs of several seeds.

    Returns:
        Control steps (m,); mean times of the complete laps, s, infinity without one, shares of complete laps, and
        completion on held-out conditions, per cent, all (runs, m).

    Raises:
        SystemExit: a run was evaluated after other steps than the first.
    """
    steps, laps_s, shares, held_out = [], [], [], []
    for run in runs:
        rows = [row for row in read_metrics(run) if row["eval_completion"] is not None]
        steps.append([int(row["env_steps"]) for row in rows])
        laps_s.append(
            [math.inf if row["eval_lap_time_s"] is None else row["eval_lap_time_s"] for row in rows]
        )
        shares.append([row["eval_lap_share"] for row in rows])
        held_out.append([row["held_out_completion"] for row in rows])
        if steps[-1] != steps[0]:
            raise SystemExit(f"{run}: was not evaluated after the same steps as {runs[0]}")
    return steps[0], np.array(laps_s, np.float64), np.array(shares), np.array(held_out)


def measure(runs: Sequence[Path], driven: Sequence[Driven], bound: float) -> dict[str, Any]:
    """Return the figures of the runs of a track and recipe and of their best checkpoints, JSON types."""
    steps, laps_s, shares, held_out = evaluations(runs)
    middle, low, high = iqm_band(laps_s)
    early = [lap_s for step, lap_s in zip(steps, middle, strict=True) if step <= EARLY_STEPS]
    return {
        "steps": steps,
        "laps_s": [_json(value) for value in middle],
        "interval_s": [_ends((a, b)) for a, b in zip(low, high, strict=True)],
        "lap_share": [round(float(share), 4) for share in shares.mean(axis=0)],
        "held_out": [round(float(value), 1) for value in np.median(held_out, axis=0)],
        "best": {
            "lap_s": median([best.lap_time_s for best in driven]),
            "completion": median([best.completion for best in driven]),
            "held_out": median([best.held_out_completion for best in driven]),
            "seeds": [best.named("best") for best in driven],
        },
        "worst_rise": worst_rise(middle),
        "bound_s": round(bound, 3),
        "over_bound": _json(early[-1] / bound - 1) if steps[-1] >= EARLY_STEPS else None,
        "over_bound_end": _json(middle[-1] / bound - 1),
        "runs": {
            run.parents[2].name: [_json(value) for value in own]
            for run, own in zip(runs, laps_s, strict=True)
        },
    }


def worst_rise(laps_s: Values) -> float | None:
    """Return how far any lap after the first is above the fastest one before it, as a share; negative: all are faster.

    0 where there is but one; None where there is no lap, or one is infinite later.
    """
    driven = np.flatnonzero(np.isfinite(laps_s))
    if not len(driven):
        return None
    since = laps_s[driven[0] :]
    return _json(float((since[1:] / np.minimum.accumulate(since)[:-1]).max()) - 1) if len(since) > 1 else 0.0


def _json(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None


def _ends(interval: Interval) -> list[float | None] | None:
    ends = [_json(end) for end in interval]
    return None if ends == [None, None] else ends


def benchmark(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Train what is not in `folder` yet, and measure."""
    tracks, recipes = options.tracks.split(","), options.recipes.split(",")
    places = [(track, recipe) for track in tracks for recipe in recipes]
    overrides = {at: training_overrides(*at, options.steps, options.overrides) for at in places}
    # All of them before the first training: one that cannot be composed costs nothing.
    experiments = {at: compose_experiment(words)[0] for at, words in overrides.items()}
    bounds = {at: lap_bound_s(experiment) for at, experiment in experiments.items()}
    asked = [
        partial(trained, folder / f"{track}-{recipe}-{seed}", [*words, f"seed={seed}"])
        for (track, recipe), words in overrides.items()
        for seed in range(options.seeds)
    ]
    print(f"{len(asked)} runs of {len(places)} groups, {options.jobs} at once", flush=True)
    runs = at_once(options.jobs, asked)
    found: dict[str, dict[str, Any]] = {track: {} for track in tracks}
    for place, (track, recipe) in enumerate(places):
        of_group = runs[place * options.seeds : (place + 1) * options.seeds]
        driven = [drive(run, ["best"])[0] for run in of_group]
        found[track][recipe] = measure(of_group, driven, bounds[track, recipe])
    return found


def markdown(found: dict[str, dict[str, Any]]) -> str:
    """Return the table of tracks and recipes."""
    head = (
        "track, recipe",
        "bound (s)",
        "fastest (s)",
        "at the end (s)",
        "interval",
        "worst rise",
        "1.5 M over bound",
        "end",
        "best: lap (s)",
        "held-out done (%)",
    )
    rows = []
    for track, recipes in found.items():
        for recipe, figures in recipes.items():
            laps_s = [lap_s for lap_s in figures["laps_s"] if lap_s is not None]
            rows.append(
                (
                    f"`{track}`, {recipe}",
                    _seconds(figures["bound_s"]),
                    _seconds(min(laps_s, default=None)),
                    _seconds(figures["laps_s"][-1]),
                    " to ".join(map(_seconds, figures["interval_s"][-1] or ())) or "-",
                    *(percent(figures[key], 1) for key in WANTED),
                    _seconds(figures["best"]["lap_s"]),
                    number(figures["best"]["held_out"], 1),
                )
            )
    return table(head, rows)


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and store."""
    parser = benchmark_parser("longer", __doc__)
    parser.add_argument("--seeds", type=int, default=5, help="runs of each, with the seeds 0, 1, ...")
    parser.add_argument("--tracks", default=",".join(TRACKS), help="options of the group track")
    parser.add_argument("--recipes", default=",".join(RECIPES), help="default, or options of conf/experiment")
    parser.add_argument("--steps", type=int, help="control steps of each run (default: the recipe's budget)")
    parser.add_argument("--jobs", type=int, default=2, help="trainings at once")
    parser.add_argument(
        "--runs-dir", type=Path, metavar="DIR", help="keep runs here, and take the finished ones"
    )
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        found = benchmark(options, (options.runs_dir or Path(temporary)).resolve())
    print(f"\n{markdown(found)}\n\nwanted, at most: {WANTED}; held-out, at least: {WANTED_HELD_OUT}")
    given = {"seeds": options.seeds, "steps": options.steps, "overrides": options.overrides}
    write_json(options.json, {"tracks": found, "wanted": WANTED, "wanted_held_out": WANTED_HELD_OUT, **given})


if __name__ == "__main__":
    sys.exit(main())
