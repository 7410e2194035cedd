"""The notebook, cell by cell as Jupyter would run it."""

import ast
import json
from pathlib import Path
from typing import Any

import pytest
from plotly.graph_objects import Figure

NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "log_analysis.ipynb"
LAPS = ("track=Straight_track", "action_space=deepracer", "reward=progress_gain", "budget.env_steps=16384")


@pytest.fixture(scope="module")
def notebook() -> dict[str, Any]:
    return json.loads(NOTEBOOK.read_text(encoding="utf-8"))


def run(cells: list[str]) -> list[Any]:
    """Run cells one after the other in one namespace and return what each shows: the value of its last line."""
    namespace: dict[str, Any] = {"__name__": "__main__"}
    shown = []
    for number, text in enumerate(cells):
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


def test_every_cell_runs_on_a_run_of_ours(notebook, trained, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("DEEPRACER_LOG", str(trained(*LAPS).folder))
    monkeypatch.chdir(tmp_path)
    shown = run(["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"])
    assert sum(isinstance(value, Figure) for value in shown) >= 6
    for value in shown:
        if isinstance(value, Figure):
            assert value.data
    assert "- " in capsys.readouterr().out
    assert (tmp_path / "log_analysis.html").stat().st_size > 1_000_000


def test_the_notebook_holds_no_outputs(notebook):
    for cell in notebook["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
    assert NOTEBOOK.stat().st_size < 20_000


def test_the_notebook_is_one_that_jupyter_opens(notebook):
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    ids = [cell["id"] for cell in notebook["cells"]]
    assert len(set(ids)) == len(ids)
    assert {cell["cell_type"] for cell in notebook["cells"]} == {"markdown", "code"}
