"""What pruning by entropy saves a sweep, and what it costs, compared with Optuna's pruners.

    python -m benchmarks.sweep [--trials 60] [--workers 2] [--laps 64] [--reuse DIR] [--json FILE] [OVERRIDE...]

1. `deepracer-exp sweep sweep=lr_entropy track=reinvent_base` really runs, with its defaults (MLflow included).
2. Its trials that were ended early are resumed, without stopping rule and pruner, until they have used their budget, in
   copies of their runs: the same trials without pruning, in the same order.
3. Median and Hyperband, as `sweep.pruners=[median]` and `[hyperband]` set them up, are replayed on these complete runs.
4. The winner of each drives fresh laps that chose no winner (`benchmarks.fresh`); all lap times shown are of these.

Why replaying is exact. Collection in the trial's own process is deterministic, and a resumed run equals an
uninterrupted one bit for bit (`benchmarks.resume` kills runs to show it), so that a pruned training is the beginning of
the complete one. What each trial reported to Optuna must equal what its complete run reports, and a trial that used its
budget must have the same value again; otherwise the benchmark fails. A pruner knows nothing of a trial but the values
that it reports (`objectives.py`) and their steps; they are read from the rows of the complete run and reported to a
new study in memory, one by one, and the trial ends where the pruner says so. Which values there are to compare with
depends on how far the other trials are: workers are modelled as equally fast, a step and a trial taking as long as in
the sweep on average. Two things are not replayed: what the sampler would have drawn after another pruner's decisions
(all get the same trials), and time: the `minutes` of the others follow from the model, only the sweep's are measured.

Winners are chosen as the sweep does it: of the `sweep.rerank` complete trials with the best values the one that is best
on `sweep.rerank_laps` more laps. For the sweep itself this must be the winner that it has reported.

- `minutes`, `trials_per_hour`, `env_steps`, `steps_by_outcome`, `trials_by_outcome`: the last two by outcome;
- `steps_saved`: share of the control steps without pruning that were not needed;
- `lap_time_loss`: how much slower the winner's mean lap is than that of the winner without pruning, as a share;
- `best`: its trial, its value (the race score in seconds) in the sweep and on the re-ranking's laps, and its laps;
- `rivals`: the same of `no_pruning`, `median` and `hyperband`.

`--reuse DIR` leaves everything in DIR (11 MB a trial, mostly traces), resumes a sweep that was interrupted and reuses
the finished runs in it. `minutes` is then the time of all starts of the sweep; `starts` counts them.
"""

import argparse
import collections
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import optuna
import torch
from optuna.pruners import NopPruner
from optuna.trial import TrialState

from deepracer_exp.config.sweep import Pruner, compose_sweep
from deepracer_exp.sweeps.fresh_laps import fresh
from deepracer_exp.sweeps.queue.storage import open_storage
from deepracer_exp.sweeps.queue.study import load_study
from deepracer_exp.sweeps.report.best_trial import best_trial
from deepracer_exp.sweeps.report.wording import ending_of
from deepracer_exp.sweeps.search.objectives import cost
from deepracer_exp.sweeps.search.pruners import build_pruner
from deepracer_exp.sweeps.trial import Trial

from .command import at_once
from .fresh import TRIALS, Driven, drive
from .report import benchmark_parser, number, percent, table, write_json
from .stopping import lap_time_loss
from .sweep_runs import (
    Course,
    Ended,
    course_of,
    hold_against,
    makespan_s,
    pace_of,
    refuse_others,
    replay,
    score,
    started,
    whole_run,
)

READY = ("sweep=lr_entropy", "track=reinvent_base")
OWN, NO_PRUNING = "sweep", "no_pruning"
RIVALS: tuple[Pruner, ...] = ("median", "hyperband")
WANTED = {"trials_per_hour": 90, "steps_saved": 0.5, "lap_time_loss": 0.02}
"""60 trials in 40 minutes and half of the steps, at least; the loss at most."""


def winner_of(found: Sequence[Ended], objective: str, rerank: int, again: Callable[[Ended], float]) -> Ended:
    """Return the winner as a sweep chooses it.

    Args:
        found: trials with a value.
        objective: of their values.
        rerank: how many of the best race again.
        again: returns the value of that race.

    Raises:
        SystemExit: there is none.
    """
    if not found:
        raise SystemExit("no trial was complete: there is no winner to compare")
    first = sorted(found, key=lambda one: (cost([objective], [one.value or 0.0]), one.number))
    return min(first[:rerank], key=lambda one: cost([objective], [again(one)])) if rerank else first[0]


def figures(ended: Sequence[Ended], minutes: float, unpruned: Sequence[Ended]) -> dict[str, Any]:
    """Return the figures of one way to prune the trials, without those of its laps.

    Args:
        ended: its trials.
        minutes: how long it took.
        unpruned: the same trials without pruning.
    """
    steps, every = (sum(one.env_steps for one in each) for each in (ended, unpruned))
    by_outcome: dict[str, int] = collections.defaultdict(int)
    for one in ended:
        by_outcome[one.outcome] += one.env_steps
    return {
        "minutes": round(minutes, 2),
        "trials_per_hour": round(60 * len(ended) / minutes, 1),
        "env_steps": steps,
        "steps_by_outcome": dict(sorted(by_outcome.items())),
        "trials_by_outcome": dict(sorted(collections.Counter(one.outcome for one in ended).items())),
        "steps_saved": round(1 - steps / every, 4),
    }


def markdown(result: dict[str, Any]) -> str:
    """Return the table of the sweep and its rivals, and that of the steps by outcome."""
    ways = {name.replace("_", " "): one for name, one in {OWN: result, **result["rivals"]}.items()}
    head = ("pruning", "minutes", "trials/h", "steps (M)", "saved", "winner", "value", "lap (s)", "laps done")
    rows = [
        (
            name,
            number(one["minutes"], 1),
            number(one["trials_per_hour"]),
            number(one["env_steps"] / 1e6, 2),
            percent(one["steps_saved"]),
            str(one["best"]["trial"]),
            number(one["best"]["value_again"], 2),
            number(one["best"]["lap_time_s"], 2),
            percent(one["best"]["lap_share"]),
            percent(one["lap_time_loss"], 1),
        )
        for name, one in ways.items()
    ]
    outcomes = sorted({outcome for one in ways.values() for outcome in one["steps_by_outcome"]})
    spent = [
        (
            name,
            *(
                f"{one['trials_by_outcome'].get(each, 0)}: {one['steps_by_outcome'].get(each, 0) / 1e6:.2f} M"
                for each in outcomes
            ),
        )
        for name, one in ways.items()
    ]
    return f"{table((*head, 'loss'), rows)}\n\n{table(('trials: steps', *outcomes), spent)}"


def benchmark(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run what is not in `folder` yet, and measure."""
    torch.set_num_threads(1)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    overrides = [*READY, *options.overrides]
    overrides += [f"sweep.trials={options.trials}", f"sweep.workers={options.workers}"]
    request = compose_sweep(overrides)
    refuse_others(request)
    config = request.entry.sweep
    (objective,) = config.objectives
    noted = started(overrides, folder)
    study = load_study(request.study, open_storage(config.storage, folder / "runs"))
    trials = study.get_trials(deepcopy=False)
    own_runs = {
        trial.number: Trial.of(trial).runs[0].folder(folder / "runs" / request.study) for trial in trials
    }
    cut_short = [trial.number for trial in trials if ending_of(trial) not in ("finished", "failed")]
    resumed = at_once(
        options.workers,
        [partial(whole_run, own_runs[number], folder / "whole" / f"{number:03d}") for number in cut_short],
    )
    whole_runs = own_runs | dict(zip(cut_short, resumed, strict=True))
    courses = [
        course_of(trial.number, whole_runs[trial.number], objective, request.protocol) for trial in trials
    ]
    for trial, course in zip(trials, courses, strict=True):
        hold_against(trial, course)

    own = [
        Course(
            number=trial.number,
            points=(),
            env_steps=Trial.of(trial).env_steps,
            outcome=ending_of(trial),
            value=trial.values[0] if trial.state == TrialState.COMPLETE else None,
        )
        for trial in trials
    ]
    again = partial(
        replay,
        pace=pace_of(trials),
        workers=config.workers or 1,
        direction=study.direction,
        study_name=request.study,
    )
    ended = {OWN: again(own, NopPruner(), ""), NO_PRUNING: again(courses, NopPruner(), "")}
    evaluations = max(len(course.points) for course in courses) or None
    for rival in RIVALS:
        ended[rival] = again(courses, build_pruner(replace(config, pruners=(rival,)), evaluations), rival)
    # Start, re-ranking and report, and what the model of the workers leaves out.
    besides_s = max(noted["seconds"] - makespan_s(ended[OWN]), 0.0)

    test = fresh(request.protocol, config.rerank_laps)
    driven: dict[Path, Driven] = {}
    found: dict[str, dict[str, Any]] = {}
    for name, each in ended.items():
        runs = own_runs if name == OWN else whole_runs

        def value_again(one: Ended, runs: dict[int, Path] = runs) -> float:
            return score(runs[one.number], objective, test)

        won = winner_of([one for one in each if one.value is not None], objective, config.rerank, value_again)
        run = runs[won.number]
        if run not in driven:
            (driven[run],) = drive(run, [None], options.laps)
        seconds = noted["seconds"] if name == OWN else makespan_s(each) + besides_s
        best = {"trial": won.number, "value": won.value, "value_again": value_again(won)}
        found[name] = {
            **figures(each, seconds / 60, ended[NO_PRUNING]),
            "best": {**best, **asdict(driven[run])},
            "laps_of": driven[run],
        }
    unpruned = found[NO_PRUNING]["laps_of"]
    for one in found.values():
        one["lap_time_loss"] = lap_time_loss(one.pop("laps_of"), unpruned)
    winner = best_trial(study).number
    if found[OWN]["best"]["trial"] != winner:
        raise SystemExit(
            f"the sweep says that trial {winner} has won, this benchmark {found[OWN]['best']['trial']}"
        )
    return {
        **found.pop(OWN),
        "rivals": found,
        "wanted": WANTED,
        "trials": len(trials),
        "workers": options.workers,
        "starts": noted["starts"],
        "overrides": overrides,
        "laps": options.laps,
        "ended": {name: [asdict(one) for one in each] for name, each in ended.items()},
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("sweep", __doc__, "sweep")
    parser.add_argument("--trials", type=int, default=60, help="of the sweep")
    parser.add_argument("--workers", type=int, default=2, help="of the sweep, and trainings that run at once")
    parser.add_argument("--laps", type=int, default=TRIALS, help="fresh laps that each winner drives")
    parser.add_argument(
        "--reuse", type=Path, metavar="DIR", help="keep everything here, and resume what is there"
    )
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        result = benchmark(options, (options.reuse or Path(temporary)).resolve())
    write_json(options.json, result)
    print(f"\n{markdown(result)}\n\nwanted: {WANTED}")
    print(json.dumps({key: value for key, value in result.items() if key != "ended"}))


if __name__ == "__main__":
    main()
