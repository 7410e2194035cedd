"""What a racer finds by name in MLflow: metrics, parameters, tags, the columns of the runs table."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .flatten import Scalar, flatten

METRICS: Mapping[str, str] = {
    "completion": "per cent of the lap driven per finished episode, mean",
    "lap_share": "share of the last episodes that completed the lap (0 to 1)",
    "best_lap_time_s": "fastest lap so far",
    "mean_lap_time_s": "mean time of the iteration's completed laps",
    "laps": "laps completed so far",
    "mean_return": "sum of rewards per finished episode, mean",
    "entropy": "entropy of the policy",
    "kl": "change of the policy in this iteration (KL divergence)",
    "policy_loss": "clipped policy loss",
    "value_loss": "loss of the value network",
    "lr": "learning rate",
    "episodes": "episodes finished so far",
    "env_steps_per_s": "control steps per second of wall time",
    "iteration": "training iteration",
}
"""Metrics of an iteration and what they mean; recorded against env steps.

The order counts: the comparison of runs opens with the metric that was recorded first.
"""

VIEW = "racing"
"""Name of the view of the runs table that the UI opens with."""

_COLUMNS = (
    "metrics.`best_lap_time_s`",
    "metrics.`completion`",
    "metrics.`lap_share`",
    "params.`reward`",
    "params.`network`",
    "params.`action_space`",
    "params.`algorithm.lr`",
    "params.`track`",
    "params.`seed`",
    "attributes.`Duration`",
)

EXPERIMENT_TAGS: Mapping[str, str] = {
    # Shows runs: MLflow's UI takes an experiment of unknown kind for chats of a language model.
    "mlflow.experimentKind": "custom_model_development",
    # Without it the runs table has no metric and no parameter until somebody chooses its columns.
    f"mlflow.sharedViewState.{VIEW}": json.dumps({"selectedColumns": _COLUMNS}),
}
"""Tags of an experiment, set when it is created."""


def in_order(metrics: Mapping[str, float | None]) -> list[tuple[str, float | None]]:
    """Return the items of `metrics` in the order of METRICS, unknown ones last."""
    rank = {key: place for place, key in enumerate(METRICS)}
    return sorted(metrics.items(), key=lambda item: rank.get(item[0], len(rank)))


def run_params(names: Mapping[str, str], config: Mapping[str, Any]) -> dict[str, Scalar]:
    """Return the names of the chosen options (track, reward, ...) beside every value of the experiment."""
    return {**flatten(config), **names}


def run_tags(
    names: Mapping[str, str], git_commit: str | None, reward_sha256: str, run_dir: Path
) -> dict[str, str]:
    """Return the tags of a run: its choices, where its code and reward come from, and a note that says so.

    `mlflow.source.name` and `mlflow.source.git.commit` fill the columns Source and Version of the runs table,
    `mlflow.note.content` is the description above the run.
    """
    choices = "\n".join(f"- {key}: `{value}`" for key, value in names.items())
    metrics = "\n".join(f"- `{key}`: {meaning}" for key, meaning in METRICS.items())
    tags = {
        **names,
        "reward_sha256": reward_sha256,
        "run_dir": str(run_dir),
        "mlflow.source.name": "deepracer-exp train",
        "mlflow.source.type": "LOCAL",
        "mlflow.note.content": (
            f"{choices}\n\nRun folder: `{run_dir}`\n\n"
            f"Metrics, against control steps of all cars:\n\n{metrics}\n"
        ),
    }
    if user := os.environ.get("USER"):  # containers often have a user id without a name
        tags["mlflow.user"] = user
    if git_commit:
        tags |= {"git_commit": git_commit, "mlflow.source.git.commit": git_commit}
    return tags
