"""What a training prints at its end."""

import json

import pytest

from deepracer_exp.commands.output import print_result
from deepracer_exp.config.running import MLflowTracking
from deepracer_exp.training.trainer import TrainResult


@pytest.mark.parametrize(
    ("uri", "shown"),
    [(None, "runs_dir="), ("sqlite:////elsewhere/it is.db", "'tracking.uri=sqlite:////elsewhere/it is.db'")],
)
def test_a_finished_training_names_the_store_that_recorded_it(trained, capsys, uri, shown):
    folder = trained().folder
    summary = json.loads((folder / "summary.json").read_text())
    result = TrainResult(summary["status"], summary["reason"], 0, folder, summary)
    print_result(result, MLflowTracking(kind="mlflow", uri=uri))
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "compare runs" in line)
    assert f" ui {shown}" in line
    print_result(result, None)
    assert "compare runs" not in capsys.readouterr().out
