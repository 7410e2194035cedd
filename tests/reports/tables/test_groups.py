"""Groups of runs: which there are, what they scored, whether they differ, and how they are drawn."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from deepracer_exp.reports.charts.group_charts import best_checkpoints, learning_curve_charts
from deepracer_exp.reports.tables.evidence import SAME, TOO_FEW, estimate
from deepracer_exp.reports.tables.group_tables import (
    curves_table,
    differences_table,
    group_curve,
    groups_as_json,
    scored,
    sentences,
)
from deepracer_exp.reports.tables.groups import RunGroup, compared, group_runs
from deepracer_exp.runs.run_files import RunRecord, read_record

from .chart_layers import drawn, layers
from .made_up_runs import made_up_run, made_up_seeds


def alone(records: list[RunRecord]) -> list[tuple[None, RunRecord]]:
    return [(None, record) for record in records]


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> list[RunGroup]:
    """Two groups of five seeds on two tracks; the second is faster by far on both."""
    records, folder = [], tmp_path_factory.mktemp("two")
    for track, length in (("reinvent_base", 1.0), ("Oval_track", 2.0)):
        for words, lap_s in ((["algorithm.lr=1e-4"], 9.0), (["algorithm.lr=1e-3"], 8.0)):
            records += made_up_seeds(folder, [f"track={track}", *words], length * lap_s)
    return group_runs(alone(records))


def test_runs_that_differ_in_seed_and_track_alone_are_a_group_named_by_what_differs(two):
    assert [group.name for group in two] == ["algorithm.lr=1e-4", "algorithm.lr=1e-3"]
    assert [len(group.records) for group in two] == [10, 10]
    assert two[0].courses == ["reinvent_base", "Oval_track"]


def test_a_run_that_leaves_the_default_has_the_value_it_had(tmp_path):
    runs = [
        made_up_run(tmp_path / str(number), words)
        for number, words in enumerate(
            [[], ["algorithm.lr=3e-4", "name=x"], ["reward=racing_line", "seed=3"]]
        )
    ]
    names = [group.name for group in group_runs(alone(runs))]
    lr, reward = runs[0].config["algorithm"]["lr"], runs[0].config["reward"]["name"]
    assert names == [
        f"algorithm.lr={lr} reward={reward}",
        f"algorithm.lr=3e-4 reward={reward}",
        f"algorithm.lr={lr} reward=racing_line",
    ]


def test_names_that_were_given_decide_whatever_differs(tmp_path):
    runs = [made_up_run(tmp_path / str(number), [f"seed={number}"]) for number in range(4)]
    groups = group_runs(zip(["old", "new", "old", None], runs, strict=True))
    assert [(group.name, len(group.records)) for group in groups] == [("old", 2), ("new", 1), ("default", 1)]


def test_a_reward_function_that_was_edited_makes_a_group_of_its_own(tmp_path):
    runs = [made_up_run(tmp_path / str(number)) for number in range(2)]
    for run, sha256 in zip(runs, "12", strict=True):
        (run.path / "provenance.json").write_text(json.dumps({"reward": {"sha256": sha256 * 64}}))
    groups = group_runs(alone([read_record(run.path) for run in runs]))
    assert [group.name for group in groups] == [
        "reward_function.py=sha256 11111111",
        "reward_function.py=sha256 22222222",
    ]


def test_scores_are_those_of_the_best_checkpoints_on_each_track(two):
    table = scored(two)
    assert [row[:3] for row in table.rows[:2]] == [
        ("algorithm.lr=1e-4", "reinvent_base", "5"),
        ("algorithm.lr=1e-4", "Oval_track", "5"),
    ]
    low, high = estimate([np.linspace(8.9, 9.1, 5)]).interval
    assert table.rows[0][3] == f"9.00 ({low:.2f} to {high:.2f})"


def test_a_difference_is_found_on_each_track_and_on_all_of_them_in_shares_of_their_means(two):
    laps = [one for one in compared(two) if one.figure == "lap_time_s"]
    assert [(one.course, one.verdict) for one in laps] == [
        ("reinvent_base", "faster"),
        ("Oval_track", "faster"),
        (None, "faster"),
    ]
    assert laps[0].difference.iqm == pytest.approx(-1.0)
    # 8 against 9 s is 11.8 % of their mean, on the track that is twice as long as well.
    assert laps[2].difference.iqm == pytest.approx(-100 / 8.5, rel=0.01)
    completion = next(one for one in compared(two) if one.figure == "completion")
    assert completion.verdict == SAME
    (verdict,) = sentences(two, compared(two))
    assert verdict.startswith(
        "algorithm.lr=1e-3 against algorithm.lr=1e-4: faster by 11.8% a lap (10.9 to 12.5"
    )
    assert verdict.endswith("not chance); as sure; as robust.")
    assert any("% of the track's mean" in row[1] for row in differences_table(compared(two)).rows)


def verdict_of(tmp_path: Path, laps_s: tuple[float | None, ...], other_s: tuple[float | None, ...]) -> str:
    """Return the words on the laps of runs against those of others."""
    groups = [
        RunGroup(
            name, tuple(made_up_run(tmp_path / f"{name}{k}", lap_s=lap_s) for k, lap_s in enumerate(some))
        )
        for name, some in (("old", other_s), ("new", laps_s))
    ]
    return compared(groups)[0].words


@pytest.mark.parametrize(
    ("laps_s", "words"),
    [
        ((8.0, 8.1, 8.2, 8.3, 8.4), "faster by 0.80 s a lap (0.50 to 1.07, not chance)"),
        ((10.0, 10.1, 10.2, 10.3, 10.4), "slower by 1.20 s a lap (0.90 to 1.47, not chance)"),
        ((8.9, 8.95, 9.0, 9.1, 9.15), "may be chance)"),
        ((9.2, 9.1, 9.0, 8.9, 8.8), "as fast"),
        ((None,) * 5, "slower: it completes too few laps for a time"),
        ((8.0,), "faster by 1.00 s a lap"),
    ],
)
def test_a_verdict_has_a_number_its_interval_and_whether_it_is_chance(tmp_path, laps_s, words):
    assert verdict_of(tmp_path, laps_s, (8.8, 8.9, 9.0, 9.1, 9.2)).endswith(words)


def test_a_run_without_a_lap_is_slower_than_any(tmp_path):
    words = verdict_of(tmp_path, (8.0,), (None,))
    assert words == "faster: the other completes too few laps for a time"


def test_an_interval_that_holds_zero_has_one_end_against_the_word(tmp_path):
    words = verdict_of(tmp_path, (8.7, 8.9, 8.9, 9.1, 9.2), (8.8, 8.9, 9.0, 9.1, 9.2))
    assert re.fullmatch(r"faster by 0.03 s a lap \(-0\.\d\d to 0\.\d\d, may be chance\)", words)


def test_names_are_short_and_still_distinguish(tmp_path):
    common = ["algorithm.frames_per_iteration=4096", "network=mlp"]
    runs = [
        made_up_run(tmp_path / str(number), words)
        for number, words in enumerate(
            [
                [*common, "reward=racing_line"],
                [*common, "reward=follow_center_line"],
                ["reward=progress_delta"],
            ]
        )
    ]
    names = [group.name for group in group_runs(alone(runs))]
    assert [name.partition(" ")[0] for name in names] == [
        "reward=racing_line",
        "reward=follow_center_line",
        "reward=progress_delta",
    ]
    assert all(name.endswith("more") and len(name) < 70 for name in names)


def test_seeds_that_overlap_and_few_of_them_are_called_that(tmp_path):
    slow = made_up_seeds(tmp_path, ["algorithm.lr=1e-4"], 8.0)
    fast = made_up_seeds(tmp_path, ["algorithm.lr=1e-3"], 7.97)
    groups = group_runs(alone([*slow, *fast]))
    assert compared(groups)[0].verdict == SAME
    few = [RunGroup(group.name, group.records[:2]) for group in groups]
    assert compared(few)[0].verdict == TOO_FEW


def test_runs_without_a_lap_are_slower_than_any_and_those_without_a_result_are_left_out(tmp_path):
    groups = [
        RunGroup("laps", tuple(made_up_seeds(tmp_path, ["algorithm.lr=1e-4"], 8.0))),
        RunGroup("none", tuple(made_up_run(tmp_path / f"none{k}", [f"seed={k}"], None) for k in range(5))),
    ]
    (tmp_path / "none4" / "summary.json").unlink()
    groups[1] = RunGroup("none", (*groups[1].records[:4], read_record(tmp_path / "none4")))
    assert scored(groups).rows[1][-1] == "no lap"
    lap = compared(groups)[0]
    assert (lap.difference.iqm, lap.verdict) == (None, "slower")
    assert "1 run without an evaluation, or not ended: left out of the figures." in sentences(groups, [lap])
    chart = best_checkpoints(groups)
    assert drawn(chart).data


def test_different_conditions_are_said_to_be_different(tmp_path):
    runs = [made_up_run(tmp_path / "a"), made_up_run(tmp_path / "b", ["evaluation.trials=3"])]
    assert any("different conditions" in one for one in sentences(group_runs(alone(runs)), []))


def test_a_curve_keeps_its_last_value_and_ends_with_its_run(tmp_path):
    group = RunGroup(
        "a", (made_up_run(tmp_path / "long", evaluations=5), made_up_run(tmp_path / "short", evaluations=3))
    )
    table = group_curve(group, "eval_lap_time_s")
    assert table["env_steps"].tolist() == [1000, 2000, 3000, 4000, 5000]
    # The short run falls by a second, too: 10, 9, 8 beside 12, 11, 10, 9, 8.
    assert table["iqm"].tolist() == [11.0, 10.0, 9.0, 9.0, 8.0]
    assert table["runs"].tolist() == [2, 2, 2, 1, 1]
    assert table[["low", "high"]].isna().all().all()


def test_curves_have_bands_over_seeds_and_gaps_where_no_lap_was_completed(two, tmp_path):
    charts = learning_curve_charts(two)
    assert [chart.name for chart in charts] == ["learning_curves_reinvent_base", "learning_curves_Oval_track"]
    panel = charts[0].rows[0][0]
    assert panel.title == "Lap of the evaluated policy, usual conditions"
    assert len(layers(panel, "band")) == 2
    assert [line.name for line in layers(panel, "line")] == [group.name for group in two]
    np.testing.assert_allclose(layers(panel, "line")[1].y, [12, 11, 10, 9, 8], rtol=1e-6)
    assert "over 5 runs" in charts[0].caption
    (chart,) = learning_curve_charts(
        [
            RunGroup("none", (made_up_run(tmp_path / "first", lap_s=None),)),
            RunGroup("laps", two[0].records[:1]),
        ]
    )
    lines = [line for row in chart.rows for panel in row for line in layers(panel, "line")]
    assert sorted(line.name for line in lines if line.name) == ["laps", "none"]
    none = RunGroup("none", (made_up_run(tmp_path / "none", lap_s=None),))
    (chart,) = learning_curve_charts([none])
    titles = [panel.title for row in chart.rows for panel in row]
    assert titles == ["Completion of the evaluated policy", "Completion in training", "Return of an episode"]
    assert drawn(chart).data


def test_runs_on_several_tracks_at_once_have_the_mean_of_their_training_laps(tmp_path):
    record = made_up_run(tmp_path / "run")
    for row in record.rows:
        row |= {"mean_lap_time_s": None, "mean_lap_time_s/A": 8.0, "mean_lap_time_s/B": 12.0}
    table = group_curve(RunGroup("a", (record,)), "mean_lap_time_s")
    assert set(table["iqm"]) == {10.0}


def test_what_is_exported_is_json_and_has_all_curves(two):
    found = json.loads(json.dumps(groups_as_json(two, compared(two)), allow_nan=False))
    assert [group["track"] for group in found["groups"]] == ["reinvent_base", "Oval_track"] * 2
    assert found["groups"][0]["figures"]["lap_time_s"]["iqm"] == pytest.approx(9.0)
    assert found["differences"][0]["verdict"] == "faster"
    table = curves_table(two)
    assert len(found["curves"]) == len(table)
    assert table.groupby(["group", "track"])["curve"].nunique().tolist() == [6] * 4
