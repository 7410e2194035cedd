"""What a training prints at its end."""

import json
from pathlib import Path

import pytest

from deepracer_exp.commands.output import print_result, print_steps, print_unsent
from deepracer_exp.config.running import MLflowTracking
from deepracer_exp.training.trainer import TrainResult


@pytest.mark.parametrize(("columns", "lines"), [(80, 2), (46, 4)])
def test_a_command_is_never_broken_by_what_it_does(capsys, monkeypatch, columns, lines):
    monkeypatch.setenv("COLUMNS", str(columns))
    steps = [
        ("deepracer-exp evaluate best:season", "race it"),
        ("deepracer-exp clone best:season", "train it"),
    ]
    print_steps(steps)
    shown = capsys.readouterr().out.split("next\n")[1].splitlines()
    assert len(shown) == lines
    assert all(len(line) <= columns for line in shown)
    assert [line for line, _ in steps] == [
        line.split("#")[0].strip() for line in shown if not line.lstrip().startswith("#")
    ]


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


@pytest.mark.parametrize("store", ["http://127.0.0.1:9", None])
def test_what_mlflow_lacks_of_a_sweep_is_counted_with_the_command_that_sends_it(
    tmp_path, capsys, store, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    shown = store or f"sqlite:///{tmp_path}/runs/mlflow.db"
    for number, complete in enumerate([True, False, False]):
        run = tmp_path / "runs" / "study" / f"run-{number}"
        run.mkdir(parents=True)
        (run / "config.yaml").write_text("name: study\n")
        (run / "summary.json").write_text('{"status": "finished", "reason": "budget"}')
        tracked = {"run_id": None, "run_name": "x", "experiment": "study", "start_ms": 0, "store": shown}
        (run / "tracking.json").write_text(json.dumps(tracked | {"complete": complete}))
    print_unsent(Path("runs/study"))
    warning, command = capsys.readouterr().err.strip().splitlines()
    assert f"MLflow ({shown}): something of 2 runs was not recorded" in warning
    assert command.endswith(f" runs send tracking.uri={store}" if store else " runs send")
    (tmp_path / "runs" / "study" / "run-1" / "summary.json").unlink()  # it runs again
    print_unsent(Path("runs/study"))
    assert "something of 1 run was" in capsys.readouterr().err
