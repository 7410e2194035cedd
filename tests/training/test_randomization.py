"""A training under randomisation, and what its trace shows of it."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from deepracer_exp.config.driving import OFF, QUANTITIES
from deepracer_exp.runs.trace import read_trace

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "randomization.md").read_text(encoding="utf-8")
KEYS = (ROOT / "docs" / "randomization_keys.md").read_text(encoding="utf-8")
OVERRIDES = ("randomization=sim2real", "reward=speed_on_track", "episode.max_steps=60")


def test_a_policy_trains_under_randomization_and_the_trace_reports_each_episodes_draws(trained):
    ended = trained(*OVERRIDES)
    assert ended.code == 0, ended.stderr
    assert all(np.isfinite(row["policy_loss"]) for row in ended.metrics)
    by_episode = read_trace(ended.folder / "trace").groupby("episode")[list(QUANTITIES)]
    assert (by_episode.nunique() == 1).all(axis=None)
    draws = by_episode.first()
    assert len(draws) > 50
    assert draws["friction_scale"].nunique() == len(draws)
    assert sorted(draws["action_delay_steps"].unique()) == [0, 1, 2]


def test_the_pages_question_to_a_trace_is_answered(trained, monkeypatch, capsys):
    monkeypatch.chdir(trained(*OVERRIDES).cwd)
    (snippet,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(snippet, "docs/randomization.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) >= 1 + len(QUANTITIES)
    for name in QUANTITIES:
        assert any(line.startswith(name) for line in lines)


def table(number: int) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of a table of the page of keys."""
    tables = [text for text in re.split(r"\n(?!\|)", KEYS) if "\n|---" in text]
    lines = [line for line in tables[number].splitlines() if line.startswith("|")]
    header, _, *rows = [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in lines]
    return header, rows


@pytest.mark.parametrize("option", ["none", "aws", "sim2real"])
def test_the_pages_table_says_what_the_options_do(option):
    header, rows = table(0)
    written = {row[0]: row[header.index(option)] for row in rows}
    assert list(written) == list(QUANTITIES)
    content = yaml.safe_load((ROOT / "conf" / "randomization" / f"{option}.yaml").read_text(encoding="utf-8"))
    for name in QUANTITIES:
        low, high = content.get(name, [OFF[name], OFF[name]])
        assert written[name] == (f"{low:g}" if low == high else f"{low:g} to {high:g}")


def test_the_pages_table_says_what_pictures_differ_in():
    header, rows = table(1)
    content = yaml.safe_load((ROOT / "conf" / "randomization" / "sim2real.yaml").read_text(encoding="utf-8"))
    expected = {name: f"{low:g} to {high:g}" for name, (low, high) in content["pictures"].items()}
    assert {row[0]: row[header.index("sim2real")] for row in rows} == expected
