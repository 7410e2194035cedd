"""PPO, SAC and Stable-Baselines3's two on the same cars for equal seconds on one core: baselines to cite.

    python -m benchmarks.baselines --json FILE [--seconds 30] [--seeds 5] [--tracks A,B,...] [--algorithms A,B,...]
                                   [--jobs N] [OVERRIDE...]

For each track, seed and algorithm the default experiment is trained: `ppo` and `sac` by `deepracer-exp train`, which
evaluates and keeps trace and checkpoints meanwhile, `sb3_ppo` and `sb3_sac` by `benchmarks.sb3_timed`, which records
nothing. Cars, observation, actions, reward and hyperparameters are the same. Each training keeps to one core, `--jobs`
of them at once, by default as many as there are cores; the algorithms take turns in being first. Seconds count from the
first control step, and the iteration in progress at their end is finished. Before the first training, each algorithm
trains for a second that does not count, so that none has to compile.

The last policy drives the fresh laps of `benchmarks.fresh`, 64 on usual and 64 on held-out conditions, by its likeliest
actions. A lap is the mean time of the complete usual ones, as a share above the bound of a perfect driver of the car on
this track; completion is how far round the lap the car came, failed laps included.

FILE gets a line of JSON for each training as it ends. Those that it has are not repeated, so that an interrupted
benchmark continues, and seeds, tracks and algorithms can be added. The tables are of all that it holds:

- for each algorithm, over tracks and seeds, the interquartile mean with its 95% interval by a bootstrap that resamples
  seeds within their track (Agarwal et al., 2021, see `deepracer_exp.reports.tables.evidence`). A policy without a lap
  is slower than any: a dash stands where more than a quarter have none, in an interval those of a resample;
- for each track, the medians over seeds.
"""

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.files import atomic_write, read_text
from deepracer_exp.sim.batch import cores

from . import sac
from .all_tracks import TRACKS
from .command import run_benchmark, train
from .longer import lap_bound_s
from .report import (
    benchmark_parser,
    iqm_text,
    machine,
    median,
    number,
    over_strata,
    percent,
    table,
    with_exit_code,
)

ALGORITHMS = ("ppo", "sac", "sb3_ppo", "sb3_sac")
Row = dict[str, Any]


class Cell(NamedTuple):
    """A training."""

    track: str
    algorithm: str
    """One of `ALGORITHMS`."""
    seed: int

    def overrides(self, seconds: float, own: Sequence[str]) -> list[str]:
        """Return the overrides of `deepracer-exp train`."""
        asked = sac.Asked(self.track, "continuous", self.algorithm)
        return asked.overrides(seconds / 60, [*own, f"seed={self.seed}"])


def cells(tracks: Sequence[str], seeds: int, algorithms: Sequence[str]) -> list[Cell]:
    """Return the trainings in the order in which they begin: those that are compared one after the other."""
    order = []
    for seed in range(seeds):
        for place, track in enumerate(tracks):
            first = (seed + place) % len(algorithms)
            order += [Cell(track, name, seed) for name in (*algorithms[first:], *algorithms[:first])]
    return order


def workers(jobs: int) -> Executor:
    """Return processes each of which keeps to a core of its own, with all that it starts."""
    spawning = multiprocessing.get_context("spawn")
    free = spawning.SimpleQueue()
    for core in sorted(os.sched_getaffinity(0))[:jobs]:
        free.put(core)
    return ProcessPoolExecutor(jobs, spawning, _keep_to_one, (free,))


def _keep_to_one(free: "multiprocessing.SimpleQueue[int]") -> None:
    os.sched_setaffinity(0, {free.get()})


def bound(track: str, own: Sequence[str]) -> float:
    """Return the bound of a lap from below, s."""
    return round(lap_bound_s(compose_experiment([f"track={track}", *own])[0]), 3)


def measure(cell: Cell, seconds: float, own: Sequence[str]) -> Row:
    """Train and drive fresh laps; return the figures."""
    overrides = cell.overrides(seconds, own)
    if cell.algorithm.startswith("sb3_"):
        figures = run_benchmark("sb3_timed", "--seconds", f"{seconds:g}", *overrides)
    else:
        with tempfile.TemporaryDirectory() as folder:
            figures = sac.measure(train(overrides, Path(folder)), "last")
    return {**figures, "machine": machine()}


def stored(file: Path | None, seconds: float, own: Sequence[str]) -> list[Row]:
    """Return the rows of a file, none where there is no file.

    Raises:
        BadInput: it holds something else, or trainings of other seconds or overrides.
    """
    if file is None or not file.exists():
        return []
    accepted = "a file that benchmarks.baselines wrote, or a new one"
    try:
        rows: list[Row] = [json.loads(line) for line in read_text(file, accepted).splitlines()]
        asked = {(row["seconds"], *row["overrides"]) for row in rows}
    except (ValueError, KeyError, TypeError) as error:
        raise BadInput(file, f"is not lines of its JSON ({error})", accepted) from error
    if asked - {(seconds, *own)}:
        raise BadInput(file, "has trainings of other seconds or overrides", "theirs, or a new file")
    return rows


def benchmark(options: argparse.Namespace) -> list[Row]:
    """Train what the file does not hold yet, and return all rows."""
    tracks, algorithms = options.tracks.split(","), options.algorithms.split(",")
    seconds, own = options.seconds, options.overrides
    rows = stored(options.json, seconds, own)
    done = {(row["track"], row["algorithm"], row["seed"]) for row in rows}
    order = cells(tracks, options.seeds, algorithms)
    # All of them before the first training: one that cannot be composed costs nothing.
    for cell in order[: len(tracks) * len(algorithms)]:
        compose_experiment(cell.overrides(seconds, own))
    missing = [cell for cell in order if cell not in done]
    print(f"{len(missing)} of {len(order)} trainings, {options.jobs} at once", flush=True)
    if not missing:
        return rows
    with workers(options.jobs) as pool:
        try:
            bounds = {row["track"]: row["bound_s"] for row in rows}
            unknown = [track for track in tracks if track not in bounds]
            bounds |= zip(unknown, pool.map(partial(bound, own=own), unknown), strict=True)
            compiling = [Cell(tracks[0], algorithm, 0) for algorithm in algorithms]
            list(pool.map(partial(measure, seconds=1.0, own=own), compiling))
            running = {pool.submit(measure, cell, seconds, own): cell for cell in missing}
            for ended in as_completed(running):
                cell = running[ended]
                given = {**cell._asdict(), "seconds": seconds, "overrides": own}
                rows.append({**given, "bound_s": bounds[cell.track], **ended.result()})
                print(" ".join(map(str, cell)) + f": {_driven(rows[-1:])}", flush=True)
                if options.json is not None:
                    atomic_write(options.json, "".join(f"{json.dumps(row)}\n" for row in rows))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return rows


def summarize(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Return the figures of each algorithm over tracks and seeds: `over_strata` of each, and two counts."""
    found = {}
    for algorithm in (name for name in ALGORITHMS if any(row["algorithm"] == name for row in rows)):
        of_tracks: dict[str, list[Row]] = {}
        for row in rows:
            if row["algorithm"] == algorithm:
                of_tracks.setdefault(row["track"], []).append(row)
        strata = list(of_tracks.values())
        over_bound = [[_over_bound(row) for row in seeds] for seeds in strata]
        found[algorithm] = {
            "policies": sum(map(len, strata)),
            "without_lap": sum(share is None for seeds in over_bound for share in seeds),
            "over_bound": over_strata(over_bound),
            **{
                key: over_strata([[row[key] for row in seeds] for seeds in strata])
                for key in ("completion", "held_out_completion", "train_s", "steps")
            },
        }
    return found


def _over_bound(row: Row) -> float | None:
    return None if row["lap_time_s"] is None else row["lap_time_s"] / row["bound_s"] - 1


def _driven(rows: Sequence[Row]) -> str:
    """Return the medians of rows: lap, completion and held-out completion."""
    lap_s = number(median([row["lap_time_s"] for row in rows]), 2)
    shares = [median([row[key] for row in rows]) for key in ("completion", "held_out_completion")]
    return " / ".join([lap_s, *(number(share, 1) for share in shares)])


def markdown(rows: Sequence[Row]) -> str:
    """Return the tables of algorithms and of tracks."""
    found = summarize(rows)
    head = (
        *("algorithm", "policies", "without a lap", "lap above the bound", "completion (%)"),
        *("held-out completion (%)", "trained (s)", "steps"),
    )
    lines = [
        (
            f"`{algorithm}`",
            str(figures["policies"]),
            str(figures["without_lap"]),
            iqm_text(figures["over_bound"], partial(percent, digits=1)),
            *(
                iqm_text(figures[key], partial(number, digits=1))
                for key in ("completion", "held_out_completion", "train_s")
            ),
            iqm_text(figures["steps"], number),
        )
        for algorithm, figures in found.items()
    ]
    tracks = {row["track"]: row["bound_s"] for row in sorted(rows, key=lambda row: row["track"])}
    medians = []
    for track, bound_s in tracks.items():
        cell = [
            [row for row in rows if (row["track"], row["algorithm"]) == (track, algorithm)]
            for algorithm in found
        ]
        medians.append(
            (f"`{track}`", number(bound_s, 2), *(_driven(seeds) if seeds else "" for seeds in cell))
        )
    of_tracks = table(("track", "bound (s)", *(f"`{algorithm}`" for algorithm in found)), medians)
    caption = "Medians over seeds: lap (s) / completion (%) / held-out completion (%)."
    return f"{table(head, lines)}\n\n{caption}\n\n{of_tracks}"


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, store and print."""
    parser = benchmark_parser("baselines", __doc__, json=False)
    parser.add_argument("--json", type=Path, help="keep the figures of each training here, a line each")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each training")
    parser.add_argument("--seeds", type=int, default=5, help="trainings of each, with the seeds 0, 1, ...")
    parser.add_argument("--tracks", default=",".join(TRACKS), help="options of the group track")
    parser.add_argument("--algorithms", default=",".join(ALGORITHMS), help="some of these")
    parser.add_argument("--jobs", type=int, default=cores(), help="trainings at once, at most one a core")
    options = parser.parse_args(arguments)
    if options.seeds < 1 or not 1 <= options.jobs <= cores():
        raise BadInput(f"--seeds and --jobs: accepted: 1 or more, jobs up to {cores()}, the cores")
    if options.seconds <= 0:
        raise BadInput(f"--seconds {options.seconds:g}", "no time to train", "more than 0")
    if not set(options.algorithms.split(",")) <= set(ALGORITHMS):
        raise BadInput(f"--algorithms {options.algorithms}", "not all known", ",".join(ALGORITHMS))
    if not hasattr(os, "sched_setaffinity"):
        raise BadInput("benchmarks.baselines", "this system keeps no process to one core", "Linux")
    print(f"\n{markdown(benchmark(options))}")


if __name__ == "__main__":
    sys.exit(main())
