"""What MLflow's pages say of a run, an experiment and a registered model: Markdown, with values rounded."""

from collections.abc import Mapping
from typing import Any

from .names import best_metrics

NOTE = "mlflow.note.content"
"""Tag of a run and of an experiment that the pages show as its description."""

PICTURE, REPORT = "best_lap.png", "report.html"
"""Files of a run that a description shows or points to."""

WORKFLOW = "workflowType=machine_learning"
"""Part of an address that opens MLflow's pages for trainings: unless told otherwise they open for language models, and
no tag of an experiment changes that."""

OURS = "Trainings of `deepracer-exp`."
"""How the description of an experiment begins that nobody has edited."""

_RACE = {
    "score_s": "race score {:.2f} s",
    "lap_time_s": "lap {:.2f} s",
    "completion": "{:.1f} % of the lap",
    "held_out_completion": "{:.1f} % on conditions not trained on",
}


def in_words(metrics: Mapping[str, float | None]) -> str:
    """Return an evaluation in words: ``race score 8.34 s, lap 8.21 s, 99.1 % of the lap``.

    Args:
        metrics: by their names in MLflow; what stands before the last slash does not matter.
    """
    values = {name.rpartition("/")[2]: value for name, value in metrics.items()}
    said = [words.format(values[name]) for name, words in _RACE.items() if values.get(name) is not None]
    return ", ".join(said) or "no complete lap"


def result_note(summary: Mapping[str, Any], run_id: str, files: Mapping[str, Any]) -> str:
    """Return what came of a run, for the head of its description.

    Args:
        summary: its summary.json.
        run_id: MLflow's.
        files: of the run in MLflow.
    """
    best = summary.get("best")
    lines = [f"**{summary['status']}**: {summary['reason']}"]
    if best is not None:
        lines.append(f"**Best policy, iteration {best['iteration']}**: {in_words(best_metrics(summary))}")
    if PICTURE in files:
        lines.append(picture(run_id))
    if REPORT in files:
        lines.append(f"What the training tells: `{REPORT}` among the artifacts.")
    return "\n\n".join(lines)


def experiment_note(best_run: str, run_id: str, experiment_id: str, metrics: Mapping[str, float]) -> str:
    """Return the description of an experiment whose best run is known."""
    link = f"[{best_run}](#/experiments/{experiment_id}/runs/{run_id}?{WORKFLOW})"
    return f"{OURS} Lowest race score so far: {link}, {in_words(metrics)}.\n\n{picture(run_id)}"


def picture(run_id: str) -> str:
    """Return the picture of a run's fastest lap."""
    address = f"get-artifact?path={PICTURE}&run_uuid={run_id}"
    return f"The fastest lap of the training:\n\n![fastest lap]({address})"
