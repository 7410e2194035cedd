"""What the ready-made experiments drive among boxes and bots, beside the winners of the official boards.

    python -m benchmarks.races [--seeds 5] [--experiments A,B] [--tracks A,B] [--cars own,board] [--jobs 2]
                               [--runs-dir DIR] [--json FILE] [OVERRIDE...]

For each experiment, track, car and seed, `deepracer-exp train experiment=...` trains as the experiment has it: with the
car of today (`own`), and with that of the board's time among the others of the board (`board`). All cars of a run are
in its process, so that with `--jobs 2` a training has one core.

The best checkpoint of each then races under the protocol of the board: trials of three laps in a row from the start
line, penalties included, among the others of the board. Where those stand at fixed places, it also races among those of
the experiment, which stand elsewhere in every trial. No training's evaluation has the conditions and places of these.

JSON has in `races` a row for each experiment, track and car. Its figures have a value for each seed, null where there
is none, with the interquartile mean over seeds and its 95% bootstrap interval, where null is longer than any:

- `steps`, `train_s`: of the whole training; `safe_steps`, `safe_s`: until its first evaluation in which at least 90% of
  the laps had no crash (null: none);
- `crash_free`: share of the laps of the board's protocol that were completed without a crash; `lap_s`: mean of the
  complete laps with penalties, `best_lap_s` the fastest; `crashes_per_lap`;
- `random_crash_free`, `random_lap_s`: the same among others that stand elsewhere in every trial;
- `winner_s`: seconds a lap of the board's winner, penalties included, who drove by camera.

`--runs-dir DIR` leaves the runs in DIR and takes those that it finds finished there: an interrupted benchmark
continues.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.results import USUAL, TrialGroup

from .command import at_once, read_metrics, read_summary, trained
from .fresh import protocol, stored_policy
from .report import (
    benchmark_parser,
    iqm_text,
    number,
    over_seeds,
    percent,
    table,
    with_exit_code,
    write_json,
)


@dataclass(frozen=True, kw_only=True)
class Board:
    """An official board of a race among others (aws-deepracer-community/deepracer-race-data, leaderboards.csv)."""

    experiment: str
    """Option of conf/experiment for such races."""
    track: str
    date: str
    race: str
    """Option of conf/race with the others of the board."""
    car: str
    """Option of conf/car of that time; that of version 4 stands in for version 3 of 2020."""
    off_track_s: float
    """Penalty for leaving the track; running into another cost 5 s on all of them."""
    winner_s: float
    """Seconds a lap, penalties included: the least of the boards of its kind on this track."""


BOARDS = (
    Board(
        experiment="object_avoidance",
        track="reInvent2019_track",
        date="2024-05-30",
        race="object_avoidance",
        car="deepracer_v5",
        off_track_s=5,
        winner_s=9.044,
    ),
    Board(
        experiment="object_avoidance",
        track="Spain_track",
        date="2020-05-01",
        race="six_boxes",
        car="deepracer_v4",
        off_track_s=5,
        winner_s=26.679,
    ),
    Board(
        experiment="head_to_bot",
        track="reInvent2019_track",
        date="2020-07-01",
        race="head_to_bot",
        car="deepracer_v4",
        off_track_s=2,
        winner_s=8.33,
    ),
    Board(
        experiment="head_to_bot",
        track="Spain_track",
        date="2020-05-01",
        race="head_to_bot",
        car="deepracer_v4",
        off_track_s=5,
        winner_s=37.347,
    ),
)
SAFE = 0.9
"""Share of laps without a crash that is wanted on random boxes, within `SAFE_WITHIN_S` of training on two cores."""
SAFE_WITHIN_S = 900.0
OWN, OF_BOARD = "own", "board"
_ALWAYS = ("collector=in_process", "collector.threads=1", "tracking=off", "report=false")
_SEED = 20_240_530
"""Of the trials: a training's evaluations have 0."""
FIGURES = ("steps", "train_s", "safe_steps", "safe_s", "crash_free", "lap_s", "best_lap_s", "crashes_per_lap")
ELSEWHERE = ("random_crash_free", "random_lap_s")
"""Figures where the others of the board stand at fixed places."""


def training_overrides(board: Board, car: str, overrides: Sequence[str]) -> list[str]:
    """Return the overrides of `deepracer-exp train` of all seeds; `car` is `OWN` or `OF_BOARD`."""
    of_board = [f"car={board.car}", f"race={board.race}"] if car == OF_BOARD else []
    return [f"experiment={board.experiment}", f"track={board.track}", *of_board, *_ALWAYS, *overrides]


def board_protocol(board: Board, race: str) -> EvaluationConfig:
    """Return the protocol of a board among the others of an option of conf/race."""
    return protocol(
        f"evaluation={board.experiment}",
        f"evaluation.race={race}",
        f"evaluation.seed={_SEED}",
        f"evaluation.penalty_s.off_track={board.off_track_s:g}",
        f"evaluation.penalty_s.reversed={board.off_track_s:g}",
        "evaluation.held_out=null",
    )


def raced(run: Path, config: EvaluationConfig) -> TrialGroup:
    """Let a run's best policy race under a protocol."""
    torch.set_num_threads(1)
    experiment, policy = stored_policy(run)
    return Evaluator(experiment, config)(policy).on(USUAL)


def measure(run: Path, board: Board) -> dict[str, float | None]:
    """Return the figures of a run."""
    summary, rows = read_summary(run), read_metrics(run)
    safe = next((row for row in rows if (row.get("eval_crash_free") or 0.0) >= SAFE), {})
    on_board = raced(run, board_protocol(board, board.race))
    crashes = sum(attempt.crashes for attempt in on_board.attempts) / len(on_board.decided)
    times = on_board.lap_times_s.tolist()
    values: tuple[float | None, ...] = (
        *(summary["env_steps"], summary["wall_clock_s"], safe.get("env_steps"), safe.get("wall_clock_s")),
        *(on_board.crash_free_share, on_board.mean_lap_time_s, min(times, default=None), crashes),
    )
    figures = dict(zip(FIGURES, values, strict=True))
    if board.race != board.experiment:
        elsewhere = raced(run, board_protocol(board, board.experiment))
        values = (elsewhere.crash_free_share, elsewhere.mean_lap_time_s)
        figures |= dict(zip(ELSEWHERE, values, strict=True))
    return {name: None if value is None else round(value, 4) for name, value in figures.items()}


def benchmark(options: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Train what is not in `folder` yet, race, and return a row for each experiment, track and car."""
    experiments, tracks, cars = (
        getattr(options, name).split(",") for name in ("experiments", "tracks", "cars")
    )
    asked = [
        (board, car, training_overrides(board, car, options.overrides))
        for board in BOARDS
        if board.experiment in experiments and board.track in tracks
        for car in cars
    ]
    # All of them before the first training: one that cannot be composed costs nothing.
    composed = [compose_experiment(words)[0] for _, _, words in asked]
    calls = [
        partial(trained, folder / f"{board.track}-{board.experiment}-{car}-{seed}", [*words, f"seed={seed}"])
        for board, car, words in asked
        for seed in range(options.seeds)
    ]
    print(f"{len(calls)} runs of {len(asked)} groups, {options.jobs} at once", flush=True)
    runs = at_once(options.jobs, calls)
    rows = []
    for index, ((board, car, _), experiment) in enumerate(zip(asked, composed, strict=True)):
        of_group = runs[index * options.seeds : (index + 1) * options.seeds]
        driven = [measure(run, board) for run in of_group]
        rows.append(
            {
                "experiment": board.experiment,
                "track": board.track,
                "car": experiment.car.name,
                "trained": car,
                **{name: over_seeds([one[name] for one in driven]) for name in driven[0]},
                "board": board.date,
                "race": board.race,
                "winner_s": board.winner_s,
            }
        )
        print(table(HEAD, [_cells(rows[-1])]), flush=True)
    return rows


HEAD = (
    *("experiment, track, car", "steps", "training (s)", "90% safe (s)", "no crash", "lap (s)"),
    *("best", "crashes", "elsewhere", "winner (s)"),
)


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    def cell(name: str, digits: int = 2) -> str:
        show = percent if name.endswith("crash_free") else partial(number, digits=digits)
        return iqm_text(row[name], show) if name in row else ""

    return (
        f"{row['experiment']}, {row['track']}, {row['car']}",
        cell("steps", 0),
        cell("train_s", 0),
        cell("safe_s", 0),
        cell("crash_free"),
        cell("lap_s"),
        cell("best_lap_s"),
        cell("crashes_per_lap"),
        cell("random_crash_free"),
        number(row["winner_s"], 2),
    )


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and store."""
    parser = benchmark_parser("races", __doc__)
    parser.add_argument("--seeds", type=int, default=5, help="trainings of each, with the seeds 0, 1, ...")
    for name, known in _choices().items():
        parser.add_argument(f"--{name}", default=",".join(known), help=f"{','.join(known)}, or some of them")
    parser.add_argument("--jobs", type=int, default=2, help="trainings at once")
    parser.add_argument("--runs-dir", type=Path, help="folder of the runs; left out: they are not kept")
    options = parser.parse_args(arguments)
    for name, known in _choices().items():
        unknown = sorted(set(getattr(options, name).split(",")) - set(known))
        if unknown:
            raise BadInput(f"--{name} {','.join(unknown)}", "no board has it", ", ".join(known))
    if options.seeds < 1 or options.jobs < 1:
        raise BadInput("--seeds and --jobs: accepted: 1 or more")
    with tempfile.TemporaryDirectory() as temporary:
        rows = benchmark(options, (options.runs_dir or Path(temporary)).resolve())
    print(f"\n{table(HEAD, list(map(_cells, rows)))}")
    print(f"\nwanted: {SAFE:.0%} of laps without a crash on random boxes within {SAFE_WITHIN_S:.0f} s")
    write_json(options.json, {"races": rows, "seeds": options.seeds, "overrides": options.overrides})


def _choices() -> dict[str, list[str]]:
    """Return what may be chosen, by the name of the option."""
    return {
        "experiments": list(dict.fromkeys(board.experiment for board in BOARDS)),
        "tracks": list(dict.fromkeys(board.track for board in BOARDS)),
        "cars": [OWN, OF_BOARD],
    }


if __name__ == "__main__":
    sys.exit(main())
