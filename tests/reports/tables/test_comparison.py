import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.reports.tables.comparison import NOTHING, last_value, results, value_text
from deepracer_exp.runs.lineage import run_differences
from deepracer_exp.runs.run_files import RunRecord


def row(iteration: int, lap_s: float | None = None, **more: object) -> dict:
    found = {"iteration": iteration, "env_steps": 1000 * iteration, "wall_clock_s": 6.0 * iteration}
    found |= {"laps": iteration, "completion": 5.0 * iteration, "mean_return": 2.0, "entropy": 1.5}
    laps = {"best_lap_time_s": lap_s, "mean_lap_time_s": lap_s and lap_s + 1}
    return found | {"lap_share": 0.5, **laps, **more}


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., RunRecord]:
    """Return a run of 20 iterations."""

    def make(
        name: str, *overrides: str, lap_s: float | None = 10.0, sha256: str = "00", **more: object
    ) -> RunRecord:
        config = compose_experiment(overrides)[1].mapping
        rows = [row(iteration, lap_s, **more) for iteration in range(1, 21)]
        return RunRecord(
            tmp_path / name, config, rows, {}, {"reward": {"sha256": sha256}, "git_commit": None}
        )

    return make


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ([[], ["algorithm.lr=3e-4", "seed=7"]], {"seed": [0, 7], "algorithm.lr": [0.0013, 0.0003]}),
        ([["track=Oval_track"], []], {"track": ["Oval_track", "reinvent_base"]}),
        ([[], ["runs_dir=elsewhere", "tracking=off", "debug=true"]], {}),
    ],
    ids=["what was overridden", "tracks by their names", "nothing that the driving depends on"],
)
def test_configurations_differ_in_exactly_what_changes_the_driving(record, overrides, expected):
    records = [record(str(number), *some) for number, some in enumerate(overrides)]
    assert run_differences(records) == expected


def test_a_key_that_only_some_runs_have_shows_nothing_at_the_others(record):
    found = run_differences([record("a", "stopping=none"), record("b", "stopping=reliable")])
    assert found["stopping.episodes"] == [NOTHING, 50]


def test_a_reward_function_that_was_edited_is_a_difference_though_its_file_has_the_same_name(record):
    found = run_differences([record("a", sha256="1" * 64), record("b", sha256="2" * 64)])
    assert found == {"reward_function.py": ["sha256 11111111", "sha256 22222222"]}


def test_figures_of_the_best_checkpoint_are_those_of_the_summary(record):
    best = {"iteration": 10, "metric": "race_score", "rank": [1.0, -8.5], "eval_completion": 96.25}
    best |= {
        "eval_lap_time_s": 8.25,
        "eval_race_score_s": 8.5,
        "held_out_completion": 81.0,
        "eval_lap_share": 0.875,
    }
    evaluated = dataclasses.replace(record("a"), summary={"best": best, "reason": "done"})
    table = {name: texts for name, texts, _ in results([evaluated, record("b")])}
    assert {name: texts[0] for name, texts in table.items() if texts[1] == NOTHING} == {
        "best checkpoint": "10",
        "race score (usual and held-out), s": "8.50",
        "usual laps complete, %": "88",
        "usual completion, %": "96.2",
        "held-out completion, %": "81.0",
        "mean usual lap, s": "8.25",
    }


def test_metrics_of_the_training_are_those_of_its_last_iteration(record):
    assert last_value(record("a"), "completion") == 100.0
    assert last_value(record("a", lap_s=None), "mean_lap_time_s") is None
    both = record("a", **{"best_lap_time_s/A": 8.0, "best_lap_time_s/B": 12.0})
    both.rows[-1]["best_lap_time_s"] = None
    assert last_value(both, "best_lap_time_s") == 10.0
    both.rows[-1]["best_lap_time_s/B"] = None  # of several tracks each must have one
    assert last_value(both, "best_lap_time_s") is None


def test_the_fastest_is_the_best_and_what_no_run_has_is_left_out(record):
    table = {name: (texts, best) for name, texts, best in results([record("a"), record("b", lap_s=9.0)])}
    assert table["fastest exploring lap, s"] == (["10.00", "9.00"], 1)
    assert table["exploring laps"] == (["20", "20"], None)
    assert table["control steps"][1] is None
    assert "mean usual lap, s" not in table


def test_long_values_are_shortened_in_their_middle():
    text = value_text({"knots": list(range(100))})
    assert len(text) <= 48
    assert text.startswith('{"knots": [0, 1')
    assert text.endswith("98, 99]}")
    assert [value_text(value) for value in (None, True, "reinvent_base")] == ["null", "true", "reinvent_base"]
