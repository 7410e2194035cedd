"""Studies as a sweep leaves them, in memory, with run folders that hold metrics.jsonl alone."""

import functools
import json
import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.study import StudyDirection
from optuna.trial import TrialState, create_trial

from deepracer_exp.config.sweep import SweepConfig, compose_sweep
from deepracer_exp.sweeps.report.best_trial import FreshLaps
from deepracer_exp.sweeps.trial import SeedRun, Trial

DISTRIBUTIONS: Mapping[str, BaseDistribution] = {
    "algorithm.lr": FloatDistribution(1e-5, 1e-3, log=True),
    "algorithm.entropy_coeff": FloatDistribution(0.0, 0.05),
    "reward": CategoricalDistribution(["racing_line", "progress"]),
    "network.hidden": CategoricalDistribution(["[64,64]", "[256,256]"]),
}
SPACE = {"algorithm.lr": "tag(log, interval(1e-5, 1e-3))", "algorithm.entropy_coeff": "interval(0, 0.05)"}


@functools.cache
def _standard() -> SweepConfig:
    return compose_sweep([]).entry.sweep


def settings(**changes) -> SweepConfig:
    """Return the configuration of a sweep with four startup trials."""
    return replace(_standard(), **{"startup_trials": 4, **changes})


RUN_KEYS = {field.name for field in fields(SeedRun)}


def new_study(
    runs_dir: Path, name: str = "lr_entropy", objectives: Sequence[str] = ("race_score",), **attrs: Any
) -> optuna.Study:
    directions = [
        StudyDirection.MAXIMIZE if objective == "completion" else StudyDirection.MINIMIZE
        for objective in objectives
    ]
    study = optuna.create_study(study_name=name, directions=directions)
    attributes = {"space": SPACE, "base": ["track=reinvent_base"], "objectives": list(objectives), "seeds": 1}
    attributes |= {"protocol": "sweep", "trials": 60, "runs_dir": str(runs_dir), "mlflow_run_id": "a" * 32}
    for key, value in (attributes | attrs).items():
        study.set_user_attr(key, value)
    return study


def add(
    study: optuna.Study,
    values: Sequence[float] | None,
    ending: str = "converged",
    *,
    params: Mapping[str, Any] | None = None,
    distributions: Mapping[str, BaseDistribution] = DISTRIBUTIONS,
    seen: float | None = None,
    metrics: int = 0,
    **attrs: Any,
) -> int:
    """Add a trial, complete if it has values; `seen` is what a pruned one had, `metrics` the rows of its run."""
    number = len(study.get_trials(deepcopy=False))
    params = {"algorithm.lr": 1e-4, "algorithm.entropy_coeff": 0.01} if params is None else params
    pruned = TrialState.FAIL if ending == "failed" else TrialState.PRUNED
    run_dir = Path(study.user_attrs["runs_dir"]) / study.study_name / f"run-{number}"
    if metrics:
        write_metrics(run_dir, metrics, 1e4 if ending == "not_learning" else 20.0 + 7 * (number % 8))
    reason = f"{ending.replace('_', ' ')}: for a reason"
    run = {"seed": 0, "run_dir": str(run_dir), "status": "finished", "ending": ending, "reason": reason}
    run |= {"env_steps": 100_000, "wall_clock_s": 40.0, "lap_time_s": 9.5, "completion": 97.0}
    run |= {"held_out_completion": 85.0}
    run |= {"values": None if values is None else list(values)}
    run |= {key: attrs.pop(key) for key in RUN_KEYS & attrs.keys()}
    runs = attrs.pop("runs", (SeedRun(**run),))
    attributes = Trial(number=number, runs=runs).attributes() | {"attempt": 1}
    attributes |= {"overrides": [f"{key}={value}" for key, value in params.items()]}
    study.add_trial(
        create_trial(
            state=pruned if values is None else TrialState.COMPLETE,
            values=values,
            params=dict(params),
            distributions={key: distributions[key] for key in params},
            user_attrs=attributes | attrs,
            intermediate_values={} if seen is None else {1: 2 * seen, 2: seen},
        )
    )
    return number


def fresh_laps(trial: int, value: float, **more: Any) -> dict[str, Any]:
    """Return what a study stores of a trial's fresh laps."""
    laps = FreshLaps(
        trial=trial, values=[value], interval=[value - 0.5, value + 0.5],
        lap_time_s=None, completion=50.0, held_out_completion=40.0,
    )  # fmt: skip
    return asdict(laps) | more


def write_metrics(run_dir: Path, rows: int, lasts: float = 40.0) -> None:
    run_dir.mkdir(parents=True)
    (run_dir / "config.yaml").write_text("name: x\n")
    lines = [
        {"env_steps": 8192 * row, "entropy": 2.7 * math.exp(-row / lasts), "laps": 0}
        for row in range(1, rows + 1)
    ]
    (run_dir / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def season(
    runs_dir: Path, trials: int, objectives: Sequence[str] = ("race_score",), rows: int = 40
) -> optuna.Study:
    """Return a study with every kind of end, the same each time."""
    study, dice = new_study(runs_dir, objectives=objectives), random.Random(1)
    for _ in range(trials):
        lr = 10 ** dice.uniform(-5, -3)
        params: dict[str, Any] = {"algorithm.lr": lr, "algorithm.entropy_coeff": dice.uniform(0, 0.05)}
        params["reward"] = dice.choice(["racing_line", "progress"])
        if params["reward"] == "racing_line":
            params["network.hidden"] = dice.choice(["[64,64]", "[256,256]"])
        off = abs(math.log10(lr) + 3.5)
        completion = min(100.0, max(20.0, 104 - 30 * off + dice.gauss(0, 3)))
        lap_s = 8.6 + 1.5 * off + abs(dice.gauss(0, 0.3))
        values = {"race_score": lap_s * 100 / completion, "lap_time": lap_s, "completion": completion}
        kinds = ["converged", "finished", "overfitting", "plateau"]
        if dice.random() < 0.05:
            error = {"reason": "RunFailed: reward is NaN", "traceback": "Traceback\n  x"}
            add(study, None, "failed", params=params, **error)
        elif off > 0.9:
            ending = dice.choice(["not_learning", "collapsed", "median", "hyperband"])
            seen = dice.uniform(60, 100) if len(objectives) == 1 else None
            poor = {"completion": 20.0, "lap_time_s": None}
            add(study, None, ending, params=params, seen=seen, metrics=rows // 3, **poor)
        else:
            found = [values[name] for name in objectives]
            good = {"completion": completion, "held_out_completion": completion - 4, "lap_time_s": lap_s}
            add(study, found, dice.choice(kinds), params=params, metrics=rows, env_steps=350_000, **good)
    return study
