"""The description of a run in MLflow besides its metrics: parameters, tags, descriptions, columns of the runs table."""

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from deepracer_exp.config.overrides import key_of
from deepracer_exp.runs.labels import Labels
from deepracer_exp.runs.lineage import Lineage
from deepracer_exp.runs.run_files import BEST_LAP, REPORT, who_and_where
from deepracer_exp.runs.run_result import of_conditions

from .mlflow_metrics import BEST, METRICS, TRACK_METRICS, best_metrics, metric_name, trial_metric

Scalar = str | int | float | bool | None

LONGEST_PARAM = 250
"""Most characters of a parameter's value. MLflow 3 accepts 6000, servers before 2.10 accept 500 and before 1.28 250;
and the comparison page shows every character."""


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, Scalar]:
    """Return `config` with dotted keys; lists become compact JSON, an empty mapping becomes `{}`."""
    flat: dict[str, Scalar] = {}
    for name, value in config.items():
        key = f"{prefix}{name}"
        if isinstance(value, Mapping) and value:
            flat.update(flatten(value, f"{key}."))
        elif isinstance(value, list | tuple | Mapping):
            flat[key] = json.dumps(value, separators=(",", ":"), ensure_ascii=False)
        else:
            flat[key] = value
    return flat


def param_text(value: Scalar) -> str:
    """Return `value` as YAML writes it, shortened to `LONGEST_PARAM` characters.

    A shortened value ends in a hash of the whole, so that values that differ only after the cut look different.
    """
    text = json.dumps(value) if value is None or isinstance(value, bool) else str(value)
    if len(text) <= LONGEST_PARAM:
        return text
    mark = f"… sha256:{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    return text[: LONGEST_PARAM - len(mark)] + mark


NOTE = "mlflow.note.content"
"""Tag of a run or an experiment that MLflow shows as its description."""

NAME, USER_NOTE = "mlflow.runName", "note"
"""Tags of a run that people set: its name and a note; their own tags have keys that begin with `USER_TAG`."""

PARENT = "mlflow.parentRunId"
"""Tag of a run that is nested under another one in the UI."""

END_TAG = "end"
"""Tag of an ended run: its status and the reason."""

STUDY = "sweep.study"
"""Tag of a study's runs and of its experiment: the study's name."""

KIND = "sweep.kind"
"""Tag of the runs above others: `study` or `trial`."""

HOST = "host"
"""Tag of a run: the machine on which it began."""

_MOST_PARAMS = 12  # columns of the table; a tag of an experiment takes 5,000 characters

VIEW = "racing"
"""Name of the runs table's view that the UI opens with."""

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
    """Return the experiment tag that makes its runs table open with these columns, in this order."""
    # In pixels; at MLflow's default of 100 names and numbers are truncated.
    least = {"params": 180, "tags": 270}
    widths = {}
    for column in columns:
        kind, _, name = column.partition(".")
        widths[column] = max(least.get(kind, 100), 44 + 8 * len(name.strip("`")))
    state = {"selectedColumns": columns, "columnOrder": columns, "columnWidths": widths}
    return {f"mlflow.sharedViewState.{VIEW}": json.dumps(state)}


EXPERIMENT_TAGS: Mapping[str, str] = {
    # Without it MLflow shows the experiment as one of a language model.
    "mlflow.experimentKind": "custom_model_development",
    # Without it the runs table shows no metrics and no parameters until its columns are chosen.
    **_view(_COLUMNS),
}
"""Tags of an experiment, set when it is created."""


def study_view(objectives: Sequence[str], searched: Sequence[str]) -> dict[str, str]:
    """Return the experiment tag that makes its runs table open with a study's objectives and searched parameters."""
    metrics = dict.fromkeys(map(trial_metric, (*objectives, "lap_time", "completion")))
    columns = [
        *(f"metrics.`{name}`" for name in metrics),
        *(f"params.`{name}`" for name in searched[:_MOST_PARAMS]),
        f"tags.`{END_TAG}`",
    ]
    return _view(columns)


def joined(names: Sequence[str], between: str = "+") -> str:
    """Return up to three names joined, or their number: `18 tracks`."""
    text = between.join(names)
    # A folder's name may have 255 characters, and it contains more than the tracks.
    return text if len(names) == 1 or (len(names) <= 3 and len(text) <= 120) else f"{len(names)} tracks"


def lineage_tags(lineage: Lineage) -> dict[str, str]:
    """Return the tags of a clone: its lineage, and the parent it is nested under in the UI."""
    tags = {f"lineage.{key}": str(value) for key, value in asdict(lineage).items() if value is not None}
    return tags if lineage.parent_run_id is None else {**tags, PARENT: lineage.parent_run_id}


def user_tags() -> dict[str, str]:
    """Return the tags with the owner of a run: `mlflow.user`, which fills a column of MLflow, and `host`."""
    who = who_and_where()
    return {"mlflow.user": who["user"], HOST: who["host"]}


def label_tags(labels: Labels) -> dict[str, str]:
    """Return the tags with the labels that people give a run."""
    values = {NAME: labels.name, USER_NOTE: labels.note}
    tags = {key: value for key, value in values.items() if value is not None}
    return tags | labels.named_tags


_COMPARED = ("name", "seed", "network", "algorithm", "lr_schedule", "reward.constants", "budget.env_steps")
"""Keys and groups that are often varied: always recorded as parameters."""


def run_params(
    choices: Mapping[str, str], names: Mapping[str, str], config: Mapping[str, Any], overrides: Sequence[str]
) -> dict[str, str]:
    """Return the parameters by which runs are compared; the run's config.yaml has all values.

    These are the choices, by readable names where there are some, the often varied keys, and those of the overrides.
    """
    compared = {*_COMPARED, *({*map(key_of, overrides)} - choices.keys())}
    values = {
        key: value
        for key, value in flatten(config).items()
        if any(f"{key}.".startswith(f"{prefix}.") for prefix in compared)
    }
    return {key: param_text(value) for key, value in {**values, **choices, **names}.items()}


def run_tags(
    names: Mapping[str, str], git_commit: str | None, reward_sha256: str, run_dir: Path
) -> dict[str, str]:
    """Return the tags of a run: its choices, the origin of its code and reward, and its description.

    `mlflow.source.name` and `mlflow.source.git.commit` fill the columns Source and Version of the runs table,
    `mlflow.note.content` is the description above the run.
    """
    choices = "\n".join(f"- {key}: `{value}`" for key, value in names.items())
    metrics = "\n".join(f"- `{name}`: {meaning}" for name, meaning in METRICS.values())
    each = ", ".join(f"`{metric_name(f'{metric}/TRACK')}`" for metric in TRACK_METRICS)
    metrics += f"\n\nWith several tracks also {each}."
    tags = {
        **names,
        **user_tags(),
        "reward_sha256": reward_sha256,
        "run_dir": str(run_dir),
        "mlflow.source.name": "deepracer-exp train",
        "mlflow.source.type": "LOCAL",
        NOTE: (
            f"{choices}\n\nRun folder: `{run_dir}`\n\n"
            f"Metrics, against control steps of all cars:\n\n{metrics}\n"
        ),
    }
    if git_commit:
        tags |= {"git_commit": git_commit, "mlflow.source.git.commit": git_commit}
    return tags


WORKFLOW = "workflowType=machine_learning"
"""Part of an address that opens MLflow's pages for trainings: by default they open for language models, and no tag of
an experiment changes that."""

OURS = "Trainings of `deepracer-exp`."
"""Beginning of an experiment's description, unless it was edited."""

_RACE = {
    "lap_time_s": "mean usual lap {:.2f} s",
    "completion": "{:.1f}% of the lap",
    "held_out_completion": "{:.1f}% on held-out conditions",
    "score_s": "race score (usual and held-out) {:.2f} s",
}


def race_result(metrics: Mapping[str, float | None]) -> str:
    """Return an evaluation, by MLflow's names, in words: ``mean usual lap 8.21 s, 99.1% of the lap``."""
    values = {name.rpartition("/")[2]: value for name, value in metrics.items()}
    has_held_out = values.get("held_out_completion") is not None
    parts = [
        of_conditions(words, has_held_out).format(values[name])
        for name, words in _RACE.items()
        if values.get(name) is not None
    ]
    return ", ".join(parts) or "no complete lap"


def result_note(summary: Mapping[str, Any], run_id: str, files: Collection[str]) -> str:
    """Return the result of a run, for the top of its description; `files` are the names of its artifacts in MLflow."""
    best = summary.get("best")
    lines = [f"**{summary['status']}**: {summary['reason']}"]
    if best is not None:
        lines.append(f"**Best policy, iteration {best['iteration']}**: {race_result(best_metrics(summary))}")
    if BEST_LAP in files:
        lines.append(picture(run_id))
    if REPORT in files:
        lines.append(f"Report: `{REPORT}` among the artifacts.")
    return "\n\n".join(lines)


def experiment_note(best_run: str, run_id: str, experiment_id: str, metrics: Mapping[str, float]) -> str:
    """Return an experiment's description with its best run."""
    link = f"[{best_run}](#/experiments/{experiment_id}/runs/{run_id}?{WORKFLOW})"
    return f"{OURS} Lowest race score (usual and held-out) so far: {link}, {race_result(metrics)}.\n\n{picture(run_id)}"


def study_experiment_note(experiment_id: str, run_id: str, winner: str) -> str:
    """Return the description of a study's experiment with its winner, in words."""
    link = f"[study](#/experiments/{experiment_id}/runs/{run_id}?{WORKFLOW})"
    return f"{OURS} Winner of the {link}: {winner}."


def picture(run_id: str) -> str:
    """Return the Markdown for the picture of a run's fastest exploring lap."""
    address = f"get-artifact?path={BEST_LAP}&run_uuid={run_id}"
    return f"The fastest exploring lap:\n\n![fastest exploring lap]({address})"
