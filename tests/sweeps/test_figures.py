import itertools
import random

import numpy as np
import plotly.graph_objects as go
import pytest

from deepracer_exp.sweeps.report.figures import FEWEST_COMPLETE, figures, narrowed
from deepracer_exp.sweeps.report.wording import ENDINGS, ending_of, short_keys

from .studies import DISTRIBUTIONS, add, new_study


@pytest.fixture(scope="module")
def drawn(study):
    return figures(study)


def test_figures_are_optunas_with_a_title_and_a_layout_for_a_narrow_screen(drawn):
    assert list(drawn) == ["history", "importance", "slice", "parallel"]
    for figure in drawn.values():
        for layout in (figure["layout"], narrowed(figure)["layout"]):
            assert layout["font"]["family"] == "system-ui, sans-serif"
            assert layout["title"]["text"].startswith("<b>")
            # Plotly's own objects refuse what plotly.js does not know.
            assert go.Figure(data=figure["data"], layout=layout).data


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
    kinds = ("history", "importance", "slice", "parallel")
    of_each = {f"{kind}-{name}" for kind in kinds for name in ("lap_time", "completion")}
    assert set(found) == of_each | {"pareto-lap_time-completion"}


def test_a_rule_of_ones_own_does_not_count_as_a_used_budget(tmp_path):
    study = new_study(tmp_path)
    for ending in ("finished", "lap_under"):
        add(study, [9.0], ending)
    add(study, None, "lap_under", seen=9.0)
    assert list(map(ending_of, study.trials)) == ["finished", "other_rule", "pruned"]


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
def test_two_endings_differ_in_colour(sight):
    for one, other in itertools.combinations(ENDINGS.values(), 2):
        assert np.linalg.norm(lab(one.color, sight) - lab(other.color, sight)) > 6, (one, other)
