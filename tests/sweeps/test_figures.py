import itertools
import math
import random

import numpy as np
import optuna
import pytest

from deepracer_exp.errors import BadInput
from sweeps.fates import FATES, fate_of
from sweeps.figures import FEWEST_COMPLETE, figures, thinned
from sweeps.labels import short_keys

from .studies import DISTRIBUTIONS, add, new_study, season


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return season(tmp_path_factory.mktemp("runs"), 60)


def curves(figure):
    """Return the points of an entropy figure by fate and trial."""
    found = {}
    for trace in figure.data:
        for step, value, trial in zip(trace.x, trace.y, trace.customdata, strict=True):
            if step is not None:
                found.setdefault((trace.name, trial), []).append((step, value))
    return found


def test_every_trial_with_a_value_stands_once_in_the_history_under_its_fate(study):
    figure = figures(study)["history"]
    drawn = {(trace.name, number) for trace in figure.data if trace.mode == "markers" for number in trace.x}
    wanted = {
        (fate_of(trial).replace("_", " "), trial.number)
        for trial in study.trials
        if trial.state.name in ("COMPLETE", "PRUNED")
    }
    assert drawn == wanted


def test_the_best_so_far_never_gets_worse_and_ends_at_the_best(study):
    (line,) = (trace for trace in figures(study)["history"].data if trace.name == "best so far")
    assert all(later <= earlier for earlier, later in itertools.pairwise(line.y))
    assert line.y[-1] == pytest.approx(study.best_value, rel=1e-4)


def test_trials_without_a_lap_do_not_squeeze_the_laps_together(study):
    figure = figures(study)["history"]
    low, high = figure.layout.yaxis.range
    complete = [trial.value for trial in study.trials if trial.value is not None]
    assert low < min(complete)
    assert (max(complete) - min(complete)) / (high - low) > 0.4
    assert max(max(trace.y) for trace in figure.data) <= high
    assert figure.layout.yaxis.ticktext[-1].startswith("≥ ")


@pytest.mark.parametrize(
    ("objective", "usual", "failed"),
    [
        ("race_score", [7.65, 7.7, 7.74, 7.8, 7.85, 7.91], [226.0, 230.5]),
        ("completion", [99.0, 99.2, 99.5, 99.6, 99.8, 100.0], [5.0]),
    ],
)
def test_a_few_failures_take_no_room_from_the_others_and_are_told_with_their_values(
    tmp_path, objective, usual, failed
):
    study = new_study(tmp_path, objectives=[objective])
    for value in (*usual[:3], *failed, *usual[3:]):
        add(study, [value])
    figure = figures(study)["history"]
    low, high = figure.layout.yaxis.range
    assert (max(usual) - min(usual)) / (high - low) > 0.6
    drawn = {
        number: y
        for trace in figure.data
        if trace.mode == "markers"
        for number, y in zip(trace.x, trace.y, strict=True)
    }
    assert {drawn[3 + at] for at in range(len(failed))} == {
        max(drawn.values()) if failed[0] > 100 else min(drawn.values())
    }
    assert all(low <= y <= high for y in drawn.values())
    (note,) = [one.text for one in figure.layout.annotations]
    assert note.startswith(f"{len(failed)} trial")
    assert f"{failed[-1]:.1f}" in note


def test_the_parameter_that_decides_is_the_most_important_and_its_interval_says_how_sure_that_is(study):
    figure = figures(study)["importance"]
    (bars,) = figure.data
    assert bars.y[-1] == "lr"
    assert sum(bars.x) == pytest.approx(100, abs=0.1)
    ends = [
        (share - below, share + above)
        for share, below, above in zip(bars.x, bars.error_x.arrayminus, bars.error_x.array, strict=True)
    ]
    assert ends[-1][0] > ends[-2][1]
    assert all(0 <= low < high <= 100 for low, high in ends)
    assert f"({ends[-1][0]:.0f} to {ends[-1][1]:.0f})" in figure.layout.annotations[-1].text


def test_importance_of_a_few_trials_is_not_told(tmp_path):
    study, dice = new_study(tmp_path), random.Random(3)
    for _ in range(FEWEST_COMPLETE):
        assert "importance" not in figures(study)
        lr = 10 ** dice.uniform(-5, -3)
        add(
            study,
            [8 + abs(math.log10(lr) + 3.5)],
            params={"algorithm.lr": lr, "algorithm.entropy_coeff": dice.uniform(0, 0.05)},
        )
    assert "importance" in figures(study)


def test_the_pareto_front_is_optunas(tmp_path):
    study, dice = new_study(tmp_path, objectives=["lap_time", "completion"]), random.Random(2)
    for _ in range(30):
        add(study, [dice.uniform(8, 12), dice.uniform(60, 100)])
    (ring,) = (trace for trace in figures(study)["pareto"].data if trace.name == "Pareto front")
    best = [tuple(trial.values) for trial in study.best_trials]
    assert sorted(zip(ring.x, ring.y, strict=True)) == [pytest.approx(one, rel=1e-4) for one in sorted(best)]
    assert len(best) > 1


def test_the_entropy_of_each_run_is_drawn_under_its_fate_up_to_its_end(study):
    found = {key: points for key, points in curves(figures(study)["entropy"]).items() if "best" not in key[0]}
    with_metrics = [trial for trial in study.trials if trial.state.name != "FAIL"]
    assert set(found) == {(fate_of(trial).replace("_", " "), trial.number) for trial in with_metrics}
    assert {len(points) for points in found.values()} == {13, 40}
    assert all(points[-1][0] == 8192 * len(points) for points in found.values())


def test_runs_that_are_gone_or_torn_leave_a_figure_of_the_others(tmp_path):
    study = new_study(tmp_path)
    for _ in range(4):
        add(study, [9.0], metrics=5)
    base = tmp_path / "lr_entropy"
    (base / "run-0" / "metrics.jsonl").unlink()
    (base / "run-1" / "metrics.jsonl").write_text("{torn\nmore\n")
    (base / "run-2" / "metrics.jsonl").write_text('{"entropy": 1.0}\n{"env_steps": 5, "entropy": null}\n')
    assert {trial for _, trial in curves(figures(study)["entropy"])} == {3}


def test_the_share_of_entropy_is_drawn_where_the_rows_have_it(tmp_path):
    study = new_study(tmp_path)
    add(study, [9.0], metrics=1)
    file = tmp_path / "lr_entropy" / "run-0" / "metrics.jsonl"
    file.write_text('{"env_steps": 10, "entropy": 2.5, "entropy_share": 0.8}\n')
    figure = figures(study)["entropy"]
    assert figure.data[0].y[0] == 0.8
    assert "share" in figure.layout.yaxis.title.text


def test_thinning_keeps_both_ends_and_the_order():
    assert thinned(range(1000), 12)[::11] == [0, 999]
    assert sorted(set(thinned(range(1000), 12))) == thinned(range(1000), 12)
    assert thinned(range(5), 12) == [0, 1, 2, 3, 4]


def test_a_trial_without_a_searched_parameter_stands_apart_in_the_parallel_coordinates(study):
    lines = figures(study)["parallel"].data[0]
    (axis,) = (axis for axis in lines.dimensions if axis.label == "hidden")
    known = [trial for trial in study.trials if trial.state.name in ("COMPLETE", "PRUNED")]
    assert axis.ticktext == ("–", "[64,64]", "[256,256]")  # noqa: RUF001
    assert [value == 0 for value in axis.values] == ["network.hidden" not in trial.params for trial in known]


def test_an_empty_study_and_one_that_just_begins_have_no_figures(tmp_path):
    study = new_study(tmp_path)
    assert figures(study) == {}
    study.enqueue_trial({"algorithm.lr": 1e-4})
    study.ask({"algorithm.lr": DISTRIBUTIONS["algorithm.lr"]})
    assert figures(study) == {}


def test_a_study_of_somebody_else_is_refused():
    with pytest.raises(BadInput, match="not made by `deepracer-exp sweep`"):
        figures(optuna.create_study(study_name="theirs"))


def test_keys_are_as_short_as_tells_them_apart():
    keys = ["algorithm.lr", "reward.constants.SPEED", "lr_schedule.lr", "network", "other.network"]
    assert list(short_keys(keys).values()) == [
        "algorithm.lr", "SPEED", "lr_schedule.lr", "network", "other.network",
    ]  # fmt: skip


# Machado, Oliveira and Fernandes 2009, A Physiologically-based Model for Simulation of Color Vision Deficiency,
# severity 1.0, on linear RGB.
SIGHTS = {
    "usual": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def lab(color, sight):
    rgb = np.array([int(color[at : at + 2], 16) / 255 for at in (1, 3, 5)])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(SIGHTS[sight] @ linear, 0, 1)
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    ) / np.array([[0.9505], [1.0], [1.089]])
    xyz = to_xyz @ seen
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("sight", SIGHTS)
def test_two_fates_differ_in_colour_or_in_their_mark(sight):
    for (_, one), (_, other) in itertools.combinations(FATES.items(), 2):
        apart = np.linalg.norm(lab(one.color, sight) - lab(other.color, sight))
        assert apart > 6, (one, other, apart)
        assert apart > 20 or one.symbol != other.symbol or one.dash != other.dash, (one, other, apart)
