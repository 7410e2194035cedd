import itertools
import random
import subprocess
import sys

import numpy as np
import plotly.graph_objects as go
import pytest
from optuna.distributions import CategoricalDistribution
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances

from deepracer_exp.sweeps.report.figure_layout import narrowed
from deepracer_exp.sweeps.report.figures import FEWEST_COMPLETE, figures, thinned
from deepracer_exp.sweeps.report.labels import ENDINGS, ending_of, short_keys

from .studies import DISTRIBUTIONS, add, new_study


@pytest.fixture(scope="module")
def drawn(study):
    return figures(study)


def curves(figure):
    """Return the points of an entropy figure by outcome and trial."""
    found = {}
    for trace in figure["data"]:
        for step, value, trial in zip(trace["x"], trace["y"], trace["customdata"], strict=True):
            if step is not None:
                found.setdefault((trace["name"], trial), []).append((step, value))
    return found


def test_all_figures_have_one_style_and_a_layout_for_a_narrow_screen(drawn):
    assert list(drawn) == ["history", "importance", "slice", "parallel", "entropy"]
    for figure in drawn.values():
        desk, narrow = figure["layout"], narrowed(figure)["layout"]
        assert desk["font"]["family"] == narrow["font"]["family"] == "system-ui, sans-serif"
        assert desk["title"]["text"].startswith("<b>")
        assert narrow["height"] > 100
        # Plotly's own objects refuse what plotly.js does not know.
        assert [len(go.Figure(data=figure["data"], layout=layout).data) for layout in (desk, narrow)]
    phone = narrowed(drawn["slice"])["layout"]
    ends = [axis["domain"] for name, axis in phone.items() if name.startswith("yaxis")]
    assert len(ends) > 2
    assert all(above[0] > below[1] for above, below in itertools.pairwise(ends))


def test_the_history_has_every_complete_trial_and_the_decisive_parameter_is_the_most_important(study, drawn):
    complete = [trial for trial in study.trials if trial.state.name == "COMPLETE"]
    dots, so_far = drawn["history"]["data"]
    assert dots["x"] == [trial.number for trial in complete]
    assert so_far["y"][:-1] == [min(dots["y"][: made + 1]) for made in range(len(complete))]
    assert so_far["x"][-1] == study.trials[-1].number
    (bars,) = drawn["importance"]["data"]
    assert bars["y"][-1] == "lr"
    assert sum(bars["x"]) == pytest.approx(1, abs=0.001)


def test_the_importance_is_that_of_optuna(study, drawn):
    keys = short_keys({key for trial in study.trials for key in trial.params})
    evaluator = PedAnovaImportanceEvaluator(target_quantile=0.25)
    optunas = get_param_importances(study, evaluator=evaluator)
    (bars,) = drawn["importance"]["data"]
    assert dict(zip(bars["y"], bars["x"], strict=True)) == {
        keys[key]: value for key, value in optunas.items()
    }


def test_every_complete_trial_is_a_point_of_each_slice_it_has(study, drawn):
    complete = [trial for trial in study.trials if trial.state.name == "COMPLETE"]
    figure = drawn["slice"]
    names = [figure["layout"][f"xaxis{trace['xaxis'][1:]}"]["title"]["text"] for trace in figure["data"]]
    assert names == ["entropy_coeff", "lr", "hidden", "reward"]
    for key, trace in zip(sorted(DISTRIBUTIONS), figure["data"], strict=True):
        some = [trial for trial in complete if key in trial.params]
        assert trace["y"] == [trial.value for trial in some]
        assert trace["marker"]["color"] == [trial.number for trial in some]


def test_a_page_of_a_study_takes_none_of_the_packages_that_take_seconds_to_import(tmp_path):
    code = """
import sys
from pathlib import Path
from deepracer_exp.sweeps.report.page import study_page
from tests.sweeps.studies import add, new_study
study = new_study(Path(sys.argv[1]))
for made in range(24):
    add(study, [8.0 + made], params={"algorithm.lr": 10 ** (-5 + made / 12), "algorithm.entropy_coeff": made / 999})
assert 'id="data-importance"' in study_page(study)
print(*sorted({name.partition(".")[0] for name in sys.modules}))
"""
    line = [sys.executable, "-c", code, str(tmp_path)]
    imported = set(subprocess.run(line, check=True, capture_output=True, text=True).stdout.split())
    assert not imported & {"sklearn", "matplotlib", "plotly", "scipy", "pandas"}


@pytest.mark.parametrize(
    ("objective", "usual", "failed"),
    [
        ("race_score", [7.65, 7.7, 7.74, 7.8, 7.85, 7.91], [226.0, 230.5]),
        ("completion", [99.0, 99.2, 99.5, 99.6, 99.8, 100.0], [5.0]),
    ],
)
def test_a_few_failures_take_no_room_from_the_others(tmp_path, objective, usual, failed):
    study = new_study(tmp_path, objectives=[objective])
    for value in (*usual[:3], *failed, *usual[3:]):
        add(study, [value])
    low, high = figures(study)["history"]["layout"]["yaxis"]["range"]
    assert (max(usual) - min(usual)) / (high - low) > 0.6
    assert low < min(usual) < max(usual) < high


def test_several_objectives_have_a_figure_each_and_a_pareto_front(tmp_path):
    study, dice = new_study(tmp_path, objectives=["lap_time", "completion"]), random.Random(2)
    for made in range(30):
        if made == FEWEST_COMPLETE - 1:
            assert not [name for name in figures(study) if "importance" in name], "of so few it is chance"
        params = {
            "algorithm.lr": 10 ** dice.uniform(-5, -3),
            "algorithm.entropy_coeff": dice.uniform(0, 0.05),
        }
        add(study, [dice.uniform(8, 12), dice.uniform(60, 100)], params=params)
    found = figures(study)
    kinds = ("history", "importance", "slice")
    of_each = {f"{kind}-{name}" for kind in kinds for name in ("lap_time", "completion")}
    assert set(found) == of_each | {"pareto", "parallel"}
    others, front = ([*zip(trace["x"], trace["y"], strict=True)] for trace in found["pareto"]["data"])
    assert front == [tuple(trial.values) for trial in study.trials if trial in study.best_trials]
    assert {*others, *front} == {tuple(trial.values) for trial in study.trials}


def test_the_entropy_of_each_run_is_drawn_under_its_outcome_up_to_its_end(study, drawn):
    found = {key: points for key, points in curves(drawn["entropy"]).items() if "best" not in key[0]}
    with_metrics = [trial for trial in study.trials if trial.state.name != "FAIL"]
    assert set(found) == {(ending_of(trial).replace("_", " "), trial.number) for trial in with_metrics}
    assert {len(points) for points in found.values()} == {13, 40}
    assert all(points[-1][0] == 8192 * len(points) for points in found.values())


def test_a_rule_of_ones_own_does_not_count_as_a_used_budget(tmp_path):
    study = new_study(tmp_path)
    for ending in ("finished", "lap_under"):
        add(study, [9.0], ending)
    add(study, None, "lap_under", seen=9.0)
    assert list(map(ending_of, study.trials)) == ["finished", "other_rule", "pruned"]


def test_runs_that_are_gone_or_incomplete_leave_a_figure_of_the_others(tmp_path):
    study = new_study(tmp_path)
    for _ in range(4):
        add(study, [9.0], metrics=5)
    base = tmp_path / "lr_entropy"
    (base / "run-0" / "metrics.jsonl").unlink()
    (base / "run-1" / "metrics.jsonl").write_text("{cut\nmore\n")
    (base / "run-2" / "metrics.jsonl").write_text('{"entropy": 1.0}\n{"env_steps": 5, "entropy": null}\n')
    assert {trial for _, trial in curves(figures(study)["entropy"])} == {3}


def test_the_share_of_entropy_is_drawn_where_the_rows_have_it(tmp_path):
    study = new_study(tmp_path)
    add(study, [9.0], metrics=1)
    file = tmp_path / "lr_entropy" / "run-0" / "metrics.jsonl"
    file.write_text('{"env_steps": 10, "entropy": 2.5, "entropy_share": 0.8}\n')
    figure = figures(study)["entropy"]
    assert figure["data"][0]["y"][0] == 0.8
    assert "share" in figure["layout"]["yaxis"]["title"]["text"]


def test_thinning_keeps_both_ends_and_the_order():
    assert thinned(range(1000), 12)[::11] == [0, 999]
    assert sorted(set(thinned(range(1000), 12))) == thinned(range(1000), 12)
    assert thinned(range(5), 12) == [0, 1, 2, 3, 4]


def test_a_trial_without_a_parameter_is_at_the_dash_of_its_parallel_axis(study, drawn):
    (lines,) = drawn["parallel"]["data"]
    (axis,) = (axis for axis in lines["dimensions"] if axis["label"] == "hidden")
    complete = [trial for trial in study.trials if trial.state.name == "COMPLETE"]
    assert axis["ticktext"] == ["–", "[64,64]", "[256,256]"]  # noqa: RUF001
    assert [value == 0 for value in axis["values"]] == [
        "network.hidden" not in one.params for one in complete
    ]


def test_an_empty_study_and_one_that_just_begins_have_no_figures(tmp_path):
    study = new_study(tmp_path)
    assert figures(study) == {}
    study.enqueue_trial({"algorithm.lr": 1e-4})
    study.ask({"algorithm.lr": DISTRIBUTIONS["algorithm.lr"]})
    assert figures(study) == {}


def test_keys_are_short_and_distinct():
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
def test_two_outcomes_differ_in_colour_or_dash(sight):
    for (_, one), (_, other) in itertools.combinations(ENDINGS.items(), 2):
        apart = np.linalg.norm(lab(one.color, sight) - lab(other.color, sight))
        assert apart > 6, (one, other, apart)
        assert apart > 20 or one.dash != other.dash, (one, other, apart)


NAMES = ["discrete_small", "continuous", "discrete_21_steps_fast", "grid_5x3_slow_corners", "x" * 60]


@pytest.mark.parametrize("choices", [1, 2, 3, 5, 12])
def test_no_two_labels_below_a_panel_meet(tmp_path, choices):
    names = (NAMES + [f"reward_function_{n}" for n in range(9)])[:choices]
    kinds = {"action_space": CategoricalDistribution(names), "algorithm.lr": DISTRIBUTIONS["algorithm.lr"]}
    study = new_study(tmp_path)
    for number in range(24):
        params = {"action_space": names[number % choices], "algorithm.lr": 10 ** (-5 + number / 12)}
        add(study, [8.0 + number], params=params, distributions=kinds)
    drawn = figures(study)["slice"]
    for layout, width in ((drawn["layout"], 260), (narrowed(drawn)["layout"], 160)):
        axis, powers = layout["xaxis"], layout["xaxis2"]
        assert (axis["type"], powers["type"]) == ("category", "log")
        lines = [line for text in axis["ticktext"] for line in text.split("<br>")]
        assert len(axis["ticktext"]) == choices
        if axis["tickangle"] == -90:
            assert 13 * choices <= width
            assert max(map(len, lines)) <= 16
        else:
            assert max(map(len, lines)) * 6.3 <= width / choices
        assert 2 <= len(powers["tickvals"]) <= 4
