"""What pruning by entropy saves a sweep, and what it costs, compared with Optuna's pruners.

    python -m benchmarks.sweep [--trials 60] [--workers 2] [--reuse DIR] [--json FILE] [OVERRIDE...]

1. `deepracer-exp sweep sweep=lr_entropy track=reinvent_base` really runs, with its defaults (MLflow included).
2. Its trials that were ended early are resumed, without stopping rule and pruner, until they have used their budget, in
   copies of their runs: the same trials without pruning, in the same order.
3. Median and Hyperband, as `sweep.pruners=[median]` and `[hyperband]` set them up, are replayed on these complete runs.
4. The winner of each drives fresh laps that chose no winner (`benchmarks.fresh`); all lap times shown are of these.

Why replaying is exact. Collection in the trial's own process is deterministic, and a resumed run equals an
uninterrupted one bit for bit (`benchmarks.resume` kills runs to show it), so that a pruned training is the beginning of
the complete one. What each trial reported to Optuna must equal what its complete run reports, and a trial that used its
budget must have the same value again; otherwise the benchmark fails. A pruner knows nothing of a trial but the values
that it reports (`sweeps.objectives`) and their steps; they are read from the rows of the complete run and reported to a
new study in memory, one by one, and the trial ends where the pruner says so. Which values there are to compare with
depends on how far the other trials are: workers are modelled as equally fast, a step and a trial taking as long as in
the sweep on average. Two things are not replayed: what the sampler would have drawn after another pruner's decisions
(all get the same trials), and time: the `minutes` of the others follow from the model, only the sweep's are measured.

Winners are chosen as the sweep does it: of the `sweep.rerank` complete trials with the best values the one that is best
on `sweep.rerank_laps` more laps. For the sweep itself this must be the winner that it has reported.

- `minutes`, `trials_per_hour`, `env_steps`, `steps_by_fate`, `trials_by_fate`: the last two by outcome;
- `steps_saved`: share of the control steps without pruning that were not needed;
- `lap_time_loss`: how much slower the winner's mean lap is than that of the winner without pruning, as a share;
- `best`: its trial, its value (the race score in seconds) in the sweep and on the re-ranking's laps, and its laps;
- `rivals`: the same of `no_pruning`, `median` and `hyperband`; each with `at_equal_steps`, the winners of both among
  what was found when as many steps were driven as the more frugal one needed for all trials, and how much slower
  the sweep's winner is then (`lap_time_loss`, below zero: faster).

`--reuse DIR` leaves everything in DIR (35 MB a trial, mostly traces), resumes a sweep that was interrupted and reuses
the finished runs in it. `minutes` is then the time of all starts of the sweep; `starts` counts them.
"""

import argparse
import collections
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import optuna
import torch
from optuna.pruners import NopPruner
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.config.compose import compose_evaluation
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.config.sweep import Pruner, SweepConfig, compose_sweep
from sweeps.best import best_trial
from sweeps.objectives import cost
from sweeps.pruners import build_pruner
from sweeps.rerank import fresh
from sweeps.storage import open_storage
from sweeps.study import load_study

from .command import at_once
from .fresh import TRIALS, Driven, drive
from .pruning_replay import Course, Ended, Pace, found_within, makespan_s, replay
from .report import number, table, write_json
from .stopping import lap_time_loss, percent
from .sweep_runs import (
    course_of,
    hold_against,
    pace_of,
    refuse_others,
    score,
    started,
    whole_run,
)

READY = ("sweep=lr_entropy", "track=reinvent_base")
OWN, NO_PRUNING = "sweep", "no_pruning"
RIVALS: tuple[Pruner, ...] = ("median", "hyperband")
WANTED = {
    "trials_per_hour": 90,
    "steps_saved": 0.5,
    "lap_time_loss": 0.02,
    "lap_time_loss_at_equal_steps": 0.0,
}
"""60 trials in 40 minutes and half of the steps, at least; the losses at most."""


@dataclass(frozen=True)
class Contender:
    """A way to make the trials, and what became of them."""

    ended: Sequence[Ended]
    minutes: float
    runs: dict[int, Path]
    """By number of the trial."""


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


def steps_by_outcome(ended: Sequence[Ended]) -> dict[str, int]:
    """Return the control steps of the trials by how they ended."""
    steps: dict[str, int] = collections.defaultdict(int)
    for one in ended:
        steps[one.outcome] += one.env_steps
    return dict(sorted(steps.items()))


def figures(ended: Sequence[Ended], minutes: float, unpruned: Sequence[Ended]) -> dict[str, Any]:
    """Return what a way to make the trials came to, without its laps.

    Args:
        ended: its trials.
        minutes: that it took.
        unpruned: the same trials without pruning.
    """
    steps, every = (sum(one.env_steps for one in each) for each in (ended, unpruned))
    return {
        "minutes": round(minutes, 2),
        "trials_per_hour": round(60 * len(ended) / minutes, 1),
        "env_steps": steps,
        "steps_by_fate": steps_by_outcome(ended),
        "trials_by_fate": dict(sorted(collections.Counter(one.outcome for one in ended).items())),
        "steps_saved": round(1 - steps / every, 4),
    }


def held(result: dict[str, Any]) -> dict[str, bool]:
    """Return what came out as wanted; a winner without a lap has not."""

    def at_most(loss: float | None, most: float) -> bool:
        return loss is not None and loss <= most

    equal = [result["rivals"][rival]["at_equal_steps"]["lap_time_loss"] for rival in RIVALS]
    return {
        "trials_per_hour": result["trials_per_hour"] >= WANTED["trials_per_hour"],
        "steps_saved": result["steps_saved"] >= WANTED["steps_saved"],
        "lap_time_loss": at_most(result["lap_time_loss"], WANTED["lap_time_loss"]),
        "lap_time_loss_at_equal_steps": all(
            at_most(loss, WANTED["lap_time_loss_at_equal_steps"]) for loss in equal
        ),
    }


def markdown(result: dict[str, Any]) -> str:
    """Return the table of the sweep and its rivals, and that of the steps by outcome."""
    ways = {OWN: result, **result["rivals"]}
    head = (
        "pruning",
        "minutes",
        "trials/h",
        "steps (M)",
        "saved",
        "winner",
        "value",
        "lap (s)",
        "laps done",
        "loss",
    )
    rows = []
    for name, one in ways.items():
        equal, best = one.get("at_equal_steps"), one["best"]
        rows.append(
            (
                name.replace("_", " "),
                number(one["minutes"], 1),
                number(one["trials_per_hour"]),
                number(one["env_steps"] / 1e6, 2),
                percent(one["steps_saved"]),
                str(best["trial"]),
                number(best["value_again"], 2),
                number(best["lap_time_s"], 2),
                percent(best["lap_share"]),
                percent(one["lap_time_loss"], 1),
                "-" if equal is None else number(equal["env_steps"] / 1e6, 2),
                "-" if equal is None else number(equal["lap_time_s"], 2),
                "-" if equal is None else number(equal["sweep_lap_time_s"], 2),
            )
        )
    outcomes = sorted({outcome for one in ways.values() for outcome in one["steps_by_fate"]})
    spent = [
        (
            name.replace("_", " "),
            *(
                f"{one['trials_by_fate'].get(f, 0)}: {one['steps_by_fate'].get(f, 0) / 1e6:.2f} M"
                for f in outcomes
            ),
        )
        for name, one in ways.items()
    ]
    at_equal = ("at steps (M)", "its lap (s)", "the sweep's (s)")
    return f"{table((*head, *at_equal), rows)}\n\n{table(('trials: steps', *outcomes), spent)}"


def contenders(
    trials: Sequence[FrozenTrial],
    courses: Sequence[Course],
    config: SweepConfig,
    measured_s: float,
    runs: tuple[dict[int, Path], dict[int, Path]],
    direction: StudyDirection,
    study_name: str,
) -> tuple[dict[str, Contender], Pace]:
    """Return all ways to make the trials, the sweep's own first, and the pace of all.

    Args:
        trials: of the sweep.
        courses: their whole runs.
        config: of the sweep.
        measured_s: that the sweep took.
        runs: of the sweep, and the whole ones.
        direction: of the values.
        study_name: of the sweep.
    """
    pace, workers = pace_of(trials), config.workers or 1
    again = partial(replay, pace=pace, workers=workers, direction=direction, study_name=study_name)
    own = [
        Course(
            number=trial.number,
            points=(),
            env_steps=trial.user_attrs["env_steps"],
            outcome=trial.user_attrs["fate"],
            value=trial.values[0] if trial.state == TrialState.COMPLETE else None,
        )
        for trial in trials
    ]
    evaluations = max(len(course.points) for course in courses) or None
    ended = {OWN: again(own, NopPruner(), ""), NO_PRUNING: again(courses, NopPruner(), "")}
    for name in RIVALS:
        pruner = build_pruner(replace(config, pruners=(name,)), evaluations)
        ended[name] = again(courses, pruner, name)
    # Start, re-ranking and page, and what the model of the workers leaves out.
    besides_s = max(measured_s - makespan_s(ended[OWN]), 0.0)
    return {
        name: Contender(
            each,
            (measured_s if name == OWN else makespan_s(each) + besides_s) / 60,
            runs[0] if name == OWN else runs[1],
        )
        for name, each in ended.items()
    }, pace


def benchmark(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Make in `folder` what is not there yet, and measure."""
    torch.set_num_threads(1)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    overrides = [*READY, *options.overrides]
    overrides += [f"sweep.trials={options.trials}", f"sweep.workers={options.workers}"]
    request = compose_sweep(overrides)
    refuse_others(request)
    config = request.entry.sweep
    (objective,) = config.objectives
    protocol = compose_evaluation(["run=any", f"evaluation={config.protocol}"])[0].evaluation
    noted = started(overrides, folder)
    study = load_study(request.study, open_storage(config.storage, folder / "runs"))
    # Without those whose worker was killed while it created them.
    trials = [trial for trial in study.get_trials(deepcopy=False) if "runs" in trial.user_attrs]
    places = {
        trial.number: folder / "runs" / request.study / Path(trial.user_attrs["run_dir"] or "").name
        for trial in trials
    }
    cut_short = [trial.number for trial in trials if trial.user_attrs["fate"] not in ("finished", "failed")]
    gone_on = at_once(
        options.workers,
        [partial(whole_run, places[number], folder / "whole" / f"{number:03d}") for number in cut_short],
    )
    fulls = places | dict(zip(cut_short, gone_on, strict=True))
    courses = []
    for trial in trials:
        courses.append(course_of(trial.number, fulls[trial.number], objective, protocol))
        hold_against(trial, courses[-1])
    ways, pace = contenders(
        trials, courses, config, noted["seconds"], (places, fulls), study.direction, request.study
    )
    result = compared(ways, pace, config, protocol, options.laps)
    winner = best_trial(study).number
    if result["best"]["trial"] != winner:
        raise SystemExit(
            f"the sweep says that trial {winner} has won, this benchmark {result['best']['trial']}"
        )
    return {
        **result,
        "wanted": WANTED,
        "held": held(result),
        "trials": len(trials),
        "workers": options.workers,
        "starts": noted["starts"],
        "overrides": overrides,
        "laps": options.laps,
        "pace": asdict(pace),
        "ended": {name: [asdict(one) for one in way.ended] for name, way in ways.items()},
    }


def compared(
    ways: dict[str, Contender], pace: Pace, config: SweepConfig, protocol: EvaluationConfig, laps: int
) -> dict[str, Any]:
    """Return the figures of all ways, with the laps of their winners."""
    (objective,) = config.objectives
    test = fresh(protocol, config.rerank_laps)
    driven: dict[Path, Driven] = {}

    def best(way: Contender, found: Sequence[Ended]) -> tuple[Ended, Driven]:
        won = winner_of(
            found, objective, config.rerank, lambda one: score(way.runs[one.number], objective, test)
        )
        run = way.runs[won.number]
        if run not in driven:
            checkpoint = "best" if (run / "checkpoints" / "best").exists() else "last"
            (driven[run],) = drive(run, [checkpoint], laps)
        return won, driven[run]

    unpruned = ways[NO_PRUNING]
    every = {
        name: best(way, [one for one in way.ended if one.value is not None]) for name, way in ways.items()
    }
    found_by_way: dict[str, dict[str, Any]] = {}
    for name, way in ways.items():
        won, laps_of = every[name]
        found_by_way[name] = {
            **figures(way.ended, way.minutes, unpruned.ended),
            "lap_time_loss": lap_time_loss(laps_of, every[NO_PRUNING][1]),
            "best": {
                "trial": won.number,
                "value": won.value,
                "value_again": score(way.runs[won.number], objective, test),
                **asdict(laps_of),
            },
        }
        if name == OWN:
            continue
        steps = min(found_by_way[OWN]["env_steps"], found_by_way[name]["env_steps"])
        pairs = [found_within(each.ended, steps, pace) for each in (way, ways[OWN])]
        if not all(pairs):
            found_by_way[name]["at_equal_steps"] = {
                "env_steps": steps,
                "lap_time_s": None,
                "sweep_lap_time_s": None,
            }
            found_by_way[name]["at_equal_steps"]["lap_time_loss"] = None
            continue
        (rival, rivals), (mine, own) = best(way, pairs[0]), best(ways[OWN], pairs[1])
        found_by_way[name]["at_equal_steps"] = {
            "env_steps": steps,
            "trial": rival.number,
            "lap_time_s": rivals.lap_time_s,
            "sweep_trial": mine.number,
            "sweep_lap_time_s": own.lap_time_s,
            "lap_time_loss": lap_time_loss(own, rivals),
        }
    return {**found_by_way.pop(OWN), "rivals": found_by_way}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, prog="benchmarks.sweep"
    )
    parser.add_argument("--trials", type=int, default=60, help="of the sweep")
    parser.add_argument("--workers", type=int, default=2, help="of the sweep, and trainings that run at once")
    parser.add_argument("--laps", type=int, default=TRIALS, help="fresh laps that each winner drives")
    parser.add_argument(
        "--reuse", type=Path, metavar="DIR", help="keep everything here, and resume what is there"
    )
    parser.add_argument("--json", type=Path, help="also write the figures as JSON to this file")
    parser.add_argument("overrides", nargs="*", metavar="OVERRIDE", help="as for deepracer-exp sweep")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        result = benchmark(options, (options.reuse or Path(temporary)).resolve())
    write_json(options.json, result)
    print(f"\n{markdown(result)}\n\nwanted: {WANTED}\nheld: {result['held']}")
    print(json.dumps({key: value for key, value in result.items() if key != "ended"}))


if __name__ == "__main__":
    main()
