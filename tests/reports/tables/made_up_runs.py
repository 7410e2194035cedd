"""Runs of several seeds that were never driven: configuration, metrics and results."""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.runs.run_files import RunRecord, read_record


@cache
def _config(overrides: tuple[str, ...]) -> Mapping[str, Any]:
    return compose_experiment(overrides)[1].mapping


def made_up_run(
    folder: Path,
    overrides: Sequence[str] = (),
    lap_s: float | None = 8.0,
    evaluations: int = 5,
    **more: object,
) -> RunRecord:
    """Write a run that is evaluated every 1,000 steps and falls to `lap_s`, a second an evaluation; None: no lap."""
    seeds = [int(word.removeprefix("seed=")) for word in overrides if word.startswith("seed=")]
    config = {**_config(tuple(word for word in overrides if not word.startswith("seed=")))}
    config |= {"seed": seeds[-1]} if seeds else {}
    rows = []
    for number in range(1, 2 * evaluations + 1):
        row = {"iteration": number, "env_steps": 500 * number, "wall_clock_s": 1.0 * number, "laps": number}
        row |= {"completion": 10.0 * number, "mean_return": 2.0, "entropy": 1.5, "lap_share": 0.5}
        row |= {"best_lap_time_s": lap_s, "mean_lap_time_s": lap_s}
        tried = number % 2 == 0
        now_s = None if lap_s is None or not tried else lap_s + evaluations - number // 2
        row |= {"eval_completion": 90.0 if tried else None, "eval_lap_time_s": now_s}
        row |= {"eval_race_score_s": now_s and now_s + 1, "eval_lap_share": 0.75 if tried else None}
        rows.append(row | {"held_out_completion": 70.0 if tried else None})
    last = rows[-1]
    rank = [0.0, 90.0] if lap_s is None else [1.0, -lap_s - 1]
    best = {"iteration": 2 * evaluations, "metric": "race_score", "rank": rank, **more}
    best |= {key: last[key] for key in last if key.startswith(("eval_", "held_out"))}
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.dump(config, Dumper=yaml.CSafeDumper))
    (folder / "overrides.yaml").write_text(yaml.safe_dump(list(overrides)))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    summary = {"status": "finished", "reason": "done", "iteration": len(rows), "best": best}
    (folder / "summary.json").write_text(json.dumps(summary))
    return read_record(folder)


def made_up_seeds(
    folder: Path, overrides: Sequence[str], mean_s: float, seeds: int = 5, spread_s: float = 0.1
) -> list[RunRecord]:
    """Write runs with the seeds 0, 1, ..., whose laps are spread evenly around `mean_s`."""
    laps_s = mean_s + spread_s * np.linspace(-1, 1, seeds)
    name = "-".join(overrides).replace("=", "-") or "default"
    return [
        made_up_run(folder / f"{name}-seed{seed}", [*overrides, f"seed={seed}"], float(lap_s))
        for seed, lap_s in enumerate(laps_s)
    ]
