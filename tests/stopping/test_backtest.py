import json
from collections.abc import Callable
from pathlib import Path

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.files import read_record
from deepracer_exp.stopping.backtest import Backtest, backtest

LENGTH = 200
LEARNED_AT = 30
NAME = "20260101-000000-reinvent_base-progress_delta-seed0"


def row(iteration: int) -> dict:
    """A training that has learned after 30 iterations, and finds a faster lap after 150."""
    share = min(1.0, iteration / LEARNED_AT)
    return {
        "iteration": iteration,
        "env_steps": 1000 * iteration,
        "wall_clock_s": 0.5 * iteration,
        "laps": 10 * max(0, iteration - 10),
        "completion": 10 + 85 * share,
        "mean_return": 100 * share,
        "entropy": 2.7 - 1.5 * share,
        "lap_share": share,
        "best_lap_time_s": None if iteration < 20 else 10.0 if iteration < 150 else 9.5,
    }


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """Write a run's folder into `runs/`."""

    def make(name: str = NAME, rows: list[dict] | None = None, *overrides: str) -> Path:
        folder = tmp_path / "runs" / "default" / name
        folder.mkdir(parents=True)
        (folder / "config.yaml").write_text(compose_experiment(overrides)[1].yaml())
        rows = [row(iteration) for iteration in range(1, LENGTH + 1)] if rows is None else rows
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        return folder

    return make


def replayed(folder: Path, *overrides: str) -> Backtest:
    return backtest(read_record(folder), compose_experiment(overrides)[0].stopping, " ".join(overrides))


def test_it_reports_where_the_run_would_have_ended_and_what_that_saves_and_loses(make_run):
    found = replayed(make_run(), "stopping=entropy")
    assert found.decision.rule == "converged"
    assert found.iteration == pytest.approx(112, abs=3)
    assert found.env_steps == 1000 * found.iteration
    assert found.saved_steps == 1000 * (LENGTH - found.iteration)
    assert found.saved_s == 0.5 * (LENGTH - found.iteration)
    assert found.saved == found.saved_steps / (1000 * LENGTH)
    assert (found.lap_time_s, found.lap_time_whole_s) == (10.0, 9.5)
    assert found.lap_loss == pytest.approx(10.0 / 9.5 - 1)


def test_a_rule_that_lets_the_run_continue_saves_and_loses_nothing(make_run):
    found = replayed(make_run(), "stopping=none")
    assert found.decision is None
    assert (found.saved_steps, found.saved_s, found.lap_loss) == (0, 0.0, 0.0)


def test_laps_of_evaluations_count_where_a_run_has_them(make_run):
    rows = [
        row(i) | ({"eval_lap_time_s": 12.0 if i < 100 else 11.0} if i % 20 == 0 else {})
        for i in range(1, 200)
    ]
    found = replayed(make_run(NAME, rows), "stopping=reliable", "stopping.lap_share=1.0")
    assert found.iteration == LEARNED_AT
    assert found.lap_loss == pytest.approx(12.0 / 11.0 - 1)


def test_with_several_tracks_the_mean_of_their_laps_counts(make_run):
    of_each = {"best_lap_time_s": None, "best_lap_time_s/A": 8.0}
    folder = make_run(
        NAME, [row(i) | of_each | {"best_lap_time_s/B": 20.0 if i > 40 else None} for i in range(1, 200)]
    )
    whole = replayed(folder, "stopping=entropy")
    assert (whole.lap_time_s, whole.lap_loss) == (14.0, 0.0)
    early = replayed(folder, "stopping=reliable", "stopping.lap_share=1.0")
    assert (early.iteration, early.lap_time_s, early.lap_loss) == (LEARNED_AT, None, None)


def test_the_share_of_other_episodes_than_were_recorded_is_refused(make_run):
    folder = make_run()
    with pytest.raises(BadInput, match=r"stopping\.episodes=20: .* last 50 episodes"):
        replayed(folder, "stopping=reliable", "stopping.episodes=20")
    assert replayed(folder, "stopping=reliable").decision is not None


def test_entropy_is_measured_by_the_runs_own_action_space(make_run):
    rows = [row(i) | {"entropy": 1.6, "completion": 9.0} for i in range(1, 60)]
    many, few = (make_run(space, rows, f"action_space={space}") for space in ("discrete", "deepracer"))
    assert replayed(many, "stopping=entropy").decision is None
    assert replayed(few, "stopping=entropy").decision.rule == "not_learning"


@pytest.mark.parametrize(
    ("rows", "words"), [([], "has no iteration"), ([row(1), {"loss": 3.0}], "line 2: has no laps")]
)
def test_metrics_that_no_rule_can_be_applied_to_are_refused(make_run, rows, words):
    with pytest.raises(BadInput, match=rf"metrics\.jsonl.*{words}"):
        replayed(make_run(NAME, rows), "stopping=entropy")


def test_the_command_prints_a_line_a_run_and_rule_and_their_means(make_run, call):
    make_run(), make_run("another")
    ended = call("stopping", "replay", NAME, "runs/default/another", "stopping.converged.patience=40,80")
    assert ended.code == 0, ended.stderr
    lines = ended.stdout.splitlines()
    for name in (f"default/{NAME}", "default/another", "mean"):
        assert sum(line.startswith(name) for line in lines) == 2
    assert sum("converged.patience=40" in line for line in lines) == 3
    assert "60%" in lines[-2]  # with a patience of 40 it ends after its warm-up, 81 of 200


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["stopping=entropy"], ["RUN: missing"]),
        ([NAME, "stopping=entropie"], ["no such stopping", "did you mean entropy?"]),
        ([NAME, "stopping.converged.window=4"], ["stopping.converged.window", "patience"]),
    ],
)
def test_what_cannot_be_replayed_is_refused_in_one_line(make_run, call, arguments, words):
    make_run()
    call("stopping", "replay", *arguments).assert_refused(*words)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("metrics.jsonl", '{"iteration": 1}\n{"iter\n{"iteration": 3}\n', "line 2: is not valid JSON"),
        ("metrics.jsonl", "[1]\n", "is not a JSON object"),
        ("config.yaml", "a: [", "not YAML"),
        ("config.yaml", "", "holds no values"),
        ("summary.json", "{", "is not valid JSON"),
    ],
)
def test_files_that_no_training_wrote_are_refused_by_name(make_run, name, text, words):
    folder = make_run()
    (folder / name).write_text(text)
    with pytest.raises(BadInput, match=f"{name}.*{words}"):
        read_record(folder)
