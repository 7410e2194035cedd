"""What a racer finds by name in MLflow: metrics, parameters, tags, the columns of the runs table."""

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from deepracer_exp.config.overrides import key_of
from deepracer_exp.formats.lineage_file import Lineage

from .flatten import Scalar, flatten

METRICS: Mapping[str, tuple[str, str]] = {
    "eval_race_score_s": (
        "race/score_s",
        "seconds per complete lap of the evaluation on all its conditions, failed laps included",
    ),
    "eval_lap_time_s": ("race/lap_time_s", "mean time of the evaluation's complete laps"),
    "eval_completion": ("race/completion", "per cent of the lap driven in the evaluation, mean"),
    "held_out_completion": (
        "race/held_out_completion",
        "the same on conditions that were not trained on",
    ),
    "eval_lap_share": ("race/lap_share", "share of the evaluation's laps that were completed (0 to 1)"),
    "completion": ("train/completion", "per cent of the lap driven per finished episode, mean"),
    "lap_share": (
        "train/lap_share",
        "share of the last episodes that completed the lap (0 to 1), of several tracks the lowest",
    ),
    "best_lap_time_s": ("train/best_lap_time_s", "fastest lap so far, with actions drawn at random"),
    "mean_lap_time_s": ("train/mean_lap_time_s", "mean time of the iteration's completed laps"),
    "laps": ("train/laps", "laps completed so far"),
    "mean_return": ("train/mean_return", "sum of rewards per finished episode, mean"),
    "episodes": ("train/episodes", "episodes finished so far"),
    "iteration": ("train/iteration", "training iteration"),
    "entropy": ("update/entropy", "entropy of the policy"),
    "kl": ("update/kl", "change of the policy in this iteration (KL divergence)"),
    "policy_loss": ("update/policy_loss", "clipped policy loss"),
    "value_loss": ("update/value_loss", "loss of the value network"),
    "lr": ("update/lr", "learning rate"),
    "clip_fraction": ("update/clip_fraction", "share of samples whose step was clipped"),
    "explained_variance": ("update/explained_variance", "of the returns, by the value network"),
    "grad_norm": ("update/grad_norm", "of the gradient before it is clipped"),
    "env_steps_per_s": ("time/env_steps_per_s", "control steps per second of wall time"),
    "collect_s": ("time/collect_s", "seconds of driving in this iteration"),
    "update_s": ("time/update_s", "seconds of learning in this iteration"),
    "wall_clock_s": ("time/wall_clock_s", "seconds since the run began"),
}
"""Columns of metrics.jsonl: what MLflow calls them and what they mean; recorded against env steps.

MLflow's pages make a section of what stands before the last slash and sort the sections by their names: race, time,
train, update. Within `race` the order of recording counts: the comparison of runs opens with the first metric.
"""

BEST = "race/best/"
"""Prefix of the evaluation of the best checkpoint, recorded when the run ends."""

TRACK_METRICS = ("completion", "lap_share", "best_lap_time_s", "mean_lap_time_s")
"""Metrics that a run on several tracks has of each: column `completion/Oval_track`, in MLflow
`train/completion/Oval_track`, so that the tracks stand beside one another in one section."""


def metric_names(row: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return a row of metrics.jsonl under the names that MLflow has for its columns, in the order of METRICS.

    Columns that METRICS does not know are called `train/COLUMN` and stand last.
    """
    rank = {column: place for place, column in enumerate(METRICS)}
    named = sorted(row.items(), key=lambda item: rank.get(item[0].partition("/")[0], len(rank)))
    return {metric_name(column): value for column, value in named}


def best_metrics(summary: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the evaluation of a run's best checkpoint, from its summary, as metrics of the run."""
    best = summary.get("best") or {}
    return {
        BEST + METRICS[column][0].removeprefix("race/"): value
        for column, value in best.items()
        if column in METRICS and METRICS[column][0].startswith("race/")
    }


def evaluate_metric(column: str, track: str | None) -> str:
    """Return what MLflow calls a result of `deepracer-exp evaluate`.

    Args:
        column: that the same result has in metrics.jsonl.
        track: its label; None on the run's own, or for all tracks together.
    """
    name = f"race/evaluate/{METRICS[column][0].removeprefix('race/')}"
    return name if track is None else f"{name}/{track}"


def metric_name(column: str) -> str:
    """Return what MLflow calls a column of metrics.jsonl."""
    own, slash, track = column.partition("/")
    return (METRICS[own][0] if own in METRICS else f"train/{own}") + slash + track


PARENT = "mlflow.parentRunId"
"""Tag of a run that stands below another one in the UI."""

END_TAG = "end"
"""Tag of a run that has ended: how and why."""

_LONGEST_LABEL = 80  # MLflow takes 250 characters, older servers fewer; the UI shows about 40

_MOST_PARAMS = 12  # columns of the table; a tag of an experiment takes 5,000 characters

VIEW = "racing"
"""Name of the view of the runs table that the UI opens with."""

_COLUMNS = (
    "attributes.Duration",
    *(f"metrics.`{BEST}{name}`" for name in ("score_s", "lap_time_s", "completion")),
    *(f"metrics.`{METRICS[column][0]}`" for column in ("eval_completion", "best_lap_time_s", "completion")),
    "params.`reward`",
    "params.`network`",
    "params.`action_space`",
    "params.`algorithm.lr`",
    "params.`track`",
    "params.`seed`",
)


def _view(columns: Sequence[str]) -> dict[str, str]:
    """Return the tag of an experiment that makes its runs table open with these columns, in this order."""
    # Pixels; MLflow cuts names and numbers off at 100.
    least = {"params": 180, "tags": 270}
    widths = {}
    for column in columns:
        kind, _, name = column.partition(".")
        widths[column] = max(least.get(kind, 100), 44 + 8 * len(name.strip("`")))
    state = {"selectedColumns": columns, "columnOrder": columns, "columnWidths": widths}
    return {f"mlflow.sharedViewState.{VIEW}": json.dumps(state)}


EXPERIMENT_TAGS: Mapping[str, str] = {
    # A training; MLflow takes an experiment of unknown kind for chats of a language model.
    "mlflow.experimentKind": "custom_model_development",
    # Without it the runs table has no metric and no parameter until somebody chooses its columns.
    **_view(_COLUMNS),
}
"""Tags of an experiment, set when it is created."""


def trial_metrics(values: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return what a trial's best checkpoint came to, by objective, under names that no metric of a training has."""
    return {_trial_metric(name): value for name, value in values.items()}


def _trial_metric(objective: str) -> str:
    return f"trial/{objective}" if objective == "completion" else f"trial/{objective}_s"


def study_view(objectives: Sequence[str], searched: Sequence[str]) -> dict[str, str]:
    """Return the tag of an experiment that makes its runs table open as that of a study.

    Args:
        objectives: of the study; its trials' values come first.
        searched: parameters that trials differ in.
    """
    metrics = dict.fromkeys(map(_trial_metric, (*objectives, "lap_time", "completion")))
    columns = [
        *(f"metrics.`{name}`" for name in metrics),
        *(f"params.`{name}`" for name in searched[:_MOST_PARAMS]),
        f"tags.`{END_TAG}`",
    ]
    return _view(columns)


def track_labels(names: Sequence[str]) -> list[str]:
    """Return a label for each track that MLflow takes as part of a metric's name; no two are the same.

    Letters, digits, `_`, `-` and `.` stay as they are, anything else becomes `_`. Labels differ by more than upper
    and lower case, since some databases hold such names for the same one.
    """
    plain = [re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:_LONGEST_LABEL] for name in names]
    # A part of a path made of dots alone would lead elsewhere.
    plain = [label if label.strip(".") else f"track_{label}" for label in plain]
    given = {label.casefold() for label in plain}
    labels: list[str] = []
    used: set[str] = set()
    for label in plain:
        chosen, number = label, 1
        while chosen.casefold() in used or (number > 1 and chosen.casefold() in given):
            number += 1
            chosen = f"{label}-{number}"
        used.add(chosen.casefold())
        labels.append(chosen)
    return labels


def track_metric(metric: str, label: str) -> str:
    """Return the name of one of TRACK_METRICS for the track of this label."""
    return f"{metric}/{label}"


def joined(names: Sequence[str], between: str = "+") -> str:
    """Return up to three names in one, or how many there are: `18 tracks`."""
    text = between.join(names)
    # A folder's name takes 255 characters, and a label has more than the tracks in it.
    return text if len(names) == 1 or (len(names) <= 3 and len(text) <= 120) else f"{len(names)} tracks"


def lineage_tags(lineage: Lineage) -> dict[str, str]:
    """Return the tags of a clone: where it comes from, and the parent it stands under in the UI."""
    tags = {f"lineage.{key}": str(value) for key, value in asdict(lineage).items() if value is not None}
    return tags if lineage.parent_run_id is None else {**tags, PARENT: lineage.parent_run_id}


_COMPARED = ("name", "seed", "network", "algorithm", "lr_schedule", "reward.constants", "budget.env_steps")
"""Keys and groups that racers vary, which runs are compared by whatever their values."""


def run_params(
    choices: Mapping[str, str],
    names: Mapping[str, str],
    config: Mapping[str, Any],
    overrides: Sequence[str],
) -> dict[str, Scalar]:
    """Return what runs are compared by; config.yaml, among the run's files, has every value.

    Args:
        choices: the option of each group.
        names: what a racer calls some of them.
        config: all values of the experiment.
        overrides: that it was composed from; the values of their keys are compared, too.
    """
    compared = {*_COMPARED, *({*map(key_of, overrides)} - choices.keys())}
    values = {
        key: value
        for key, value in flatten(config).items()
        if any(f"{key}.".startswith(f"{one}.") for one in compared)
    }
    return {**values, **choices, **names}


def run_tags(
    names: Mapping[str, str], git_commit: str | None, reward_sha256: str, run_dir: Path
) -> dict[str, str]:
    """Return the tags of a run: its choices, where its code and reward come from, and a note that says so.

    `mlflow.source.name` and `mlflow.source.git.commit` fill the columns Source and Version of the runs table,
    `mlflow.note.content` is the description above the run.
    """
    choices = "\n".join(f"- {key}: `{value}`" for key, value in names.items())
    metrics = "\n".join(f"- `{name}`: {meaning}" for name, meaning in METRICS.values())
    each = ", ".join(f"`{metric_name(f'{metric}/TRACK')}`" for metric in TRACK_METRICS)
    metrics += f"\n\nWith several tracks also {each}."
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
