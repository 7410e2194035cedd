"""What a training prints at its end."""

import ast
import io
import json
from pathlib import Path

import pytest
from rich.table import Table
from rich.tree import Tree

import deepracer_exp
from deepracer_exp.commands.output import plain_console, print_result, print_steps, print_unsent
from deepracer_exp.config.running import MLflowTracking
from deepracer_exp.runs.run_result import Ending
from deepracer_exp.training.train_result import TrainResult


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
    result = TrainResult(Ending.stored(summary), 0, folder, summary)
    print_result(result, MLflowTracking(kind="mlflow", uri=uri))
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "compare runs" in line)
    assert f" ui {shown}" in line
    print_result(result, None)
    assert "compare runs" not in capsys.readouterr().out


def rows_of(*laps: tuple[int, float | None, int]) -> str:
    names = ("iteration", "eval_lap_time_s", "eval_laps")
    rows = [dict(zip(names, one, strict=True)) for one in laps]
    rows = [one | {"eval_lap_share": one["eval_laps"] / 8, "eval_laps_tried": 8} for one in rows]
    return "".join(f"{json.dumps(row)}\n" for row in rows)


@pytest.mark.parametrize(
    ("rows", "kept", "words"),
    [
        (rows_of((30, 7.0, 8), (40, 6.72, 8)), "000040", "checkpoint 40, 6.72 s, 8 of 8"),
        (
            rows_of((30, 6.5, 8), (40, 6.72, 8)),
            "000040",
            "checkpoint 30, 6.50 s, 8 of 8 (not kept)",
        ),
        (
            rows_of((30, 6.5, 5), (40, 6.72, 7)),
            "000040",
            "none yet; 95% of the usual laps must be complete, at best 88% were",
        ),
    ],
)
def test_the_last_lines_of_a_training_name_the_fastest_reliable_lap(tmp_path, capsys, rows, kept, words):
    (tmp_path / "metrics.jsonl").write_text(rows)
    (tmp_path / "checkpoints" / kept).mkdir(parents=True)
    best = {"iteration": 40, "metric": "race_score", "rank": [1.0, -8.0], "eval_completion": 100.0}
    best |= {"eval_lap_time_s": 6.72, "eval_race_score_s": 8.0}
    summary = {"iteration": 0, "env_steps": 8192, "wall_clock_s": 9.0, "episodes": 12, "laps": 3}
    summary |= {
        "status": "stopped early",
        "reason": "it does not learn",
        "best_lap_time_s": 6.1,
        "best": best,
    }
    (tmp_path / "config.yaml").write_text("name: season\n")
    print_result(TrainResult(Ending("stopped early", "it does not learn"), 0, tmp_path, summary), None)
    shown = capsys.readouterr().out.splitlines()
    assert f"  fastest reliable lap: {words}" in shown
    assert any("exploring: 12 episodes, 3 laps, the fastest in 6.10 s" in line for line in shown)
    assert "  best by race score (usual): checkpoint 40" in shown
    assert "    mean usual lap 6.72 s, usual completion 100%, race score (usual) 8.00 s" in shown


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
        tracked = {"run_id": None, "run_name": "x", "experiment": "study", "start_ms": 0, "end_ms": 1}
        tracked |= {"store": shown}
        (run / "tracking.json").write_text(json.dumps(tracked | {"complete": complete}))
    print_unsent(Path("runs/study"))
    warning, command = capsys.readouterr().err.strip().splitlines()
    assert f"MLflow ({shown}): something of 2 runs was not recorded" in warning
    assert command.endswith(f" runs send tracking.uri={store}" if store else " runs send")
    (tmp_path / "runs" / "study" / "run-1" / "summary.json").unlink()  # it runs again
    print_unsent(Path("runs/study"))
    assert "something of 1 run was" in capsys.readouterr().err


def test_consoles_print_the_words_of_users_as_they_are():
    words = "[bold] [reinvent_base] [/dim] :car: 12"
    file = io.StringIO()
    console = plain_console(file=file, force_terminal=True, color_system="truecolor", width=60)
    table = Table(words, box=None)
    table.add_row(words)
    console.print(words, table, Tree(words))
    assert [line.rstrip() for line in file.getvalue().splitlines()].count(words) >= 2
    assert file.getvalue().count(words) == 4


def test_no_other_console_prints():
    package = Path(deepracer_exp.__file__).parent
    made = {
        (
            str(file.relative_to(package)),
            call.func.id,
        )
        for file in package.rglob("*.py")
        for call in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(call, ast.Call)
        and isinstance(call.func, ast.Name)
        and call.func.id in {"Console", "Terminal"}
        and not any(keyword.arg == "quiet" for keyword in call.keywords)
    }
    assert made == {("commands/output.py", "Terminal")}
