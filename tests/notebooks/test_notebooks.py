"""The notebooks, cell by cell as Jupyter would run them."""

import ast
import json
import re
from pathlib import Path
from typing import Any

import pytest
from plotly.graph_objects import Figure

import deepracer_exp

FOLDER = Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LAPS = ("track=Straight_track", "action_space=deepracer", "reward=speed_on_track", "budget.env_steps=16384")


def run_cells(name: str, cells: int | None = None) -> list[Any]:
    """Run the first `cells` of code in one namespace, and return what each shows: the value of its last line."""
    namespace: dict[str, Any] = {"__name__": "__main__"}
    shown = []
    every = json.loads((FOLDER / name).read_text(encoding="utf-8"))["cells"]
    texts = ["".join(cell["source"]) for cell in every if cell["cell_type"] == "code"][:cells]
    for number, text in enumerate(texts):
        *body, last = ast.parse(text, f"cell {number}").body
        if not isinstance(last, ast.Expr):
            body.append(last)
            last = None
        exec(compile(ast.Module(body, []), f"cell {number}", "exec"), namespace)
        value = None
        if last is not None:
            value = eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), namespace)  # noqa: S307
        shown.append(value)
    return shown


def test_the_log_analysis_runs_on_a_run_of_ours(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("DEEPRACER_LOG", str(trained(*LAPS).folder))
    monkeypatch.chdir(tmp_path)
    shown = run_cells("log_analysis.ipynb")
    assert sum(isinstance(value, Figure) for value in shown) >= 6
    for value in shown:
        if isinstance(value, Figure):
            assert value.data
    assert "- " in capsys.readouterr().out
    assert (tmp_path / "log_analysis.html").stat().st_size > 1_000_000


def test_the_log_analysis_finds_the_newest_run_from_the_folder_of_the_notebooks(
    trained, tmp_path, monkeypatch
):
    monkeypatch.delenv("DEEPRACER_LOG", raising=False)
    run = trained(*LAPS).folder
    runs = tmp_path / "runs"
    runs.symlink_to(run.parent.parent)
    (tmp_path / "notebooks").mkdir()
    monkeypatch.chdir(tmp_path / "notebooks")
    newest = max(runs.glob("*/*/metrics.jsonl"), key=lambda file: file.stat().st_mtime).parent
    assert run_cells("log_analysis.ipynb", cells=1) == [newest.name]


def test_the_log_analysis_trains_a_short_run_where_there_is_none(tmp_path, monkeypatch):
    monkeypatch.delenv("DEEPRACER_LOG", raising=False)
    monkeypatch.chdir(tmp_path)
    (name,) = run_cells("log_analysis.ipynb", cells=1)
    assert [folder.name for folder in tmp_path.glob("runs/*/*")] == [name]


def test_an_own_training_loop_learns_with_public_names_only():
    assert run_cells("own_algorithm.ipynb")[-1] > 0.3
    text = (FOLDER / "own_algorithm.ipynb").read_text(encoding="utf-8")
    assert "deepracer_exp." not in text
    (names,) = re.findall(r"from deepracer_exp import ([\w, ]+)", text)
    assert set(names.split(", ")) <= set(deepracer_exp.__all__)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_one_that_jupyter_opens_and_holds_no_outputs(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    ids = [cell["id"] for cell in notebook["cells"]]
    assert len(set(ids)) == len(ids)
    assert {cell["cell_type"] for cell in notebook["cells"]} == {"markdown", "code"}
    for cell in notebook["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
    assert path.stat().st_size < 20_000
