"""Crashes and passes of a run among boxes and bots, told from its trace and where the others were."""

import dataclasses
import tarfile

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.others.placement import (
    PlacedOthers,
    Placement,
    rebuild_poses,
)
from deepracer_exp.reports.charts.others_charts import crash_free, crash_places, crashes_by_object, overtakes
from deepracer_exp.reports.findings import findings
from deepracer_exp.reports.pages.log_report import LogPage, draw_sections
from deepracer_exp.reports.tables.log_view import prepare
from deepracer_exp.reports.tables.others_on_road import costliest, others_on_road
from deepracer_exp.runs.recording import read_run_recording
from deepracer_exp.tracks.track import directed_tracks

ON_ROAD = "What is on the road"
MIXED = (
    *("race=head_to_bot", "race.boxes.number=2", "observation.next_objects=2"),
    "track=reInvent2019_track",
)
QUICK = ("evaluation.trials=1", "evaluation.time_s=5", "evaluation.held_out=null")


@pytest.fixture(scope="module")
def mixed(trained):
    return prepare(read_run_recording(trained(*MIXED, *QUICK).folder))


def test_every_crash_of_a_run_has_the_box_or_bot_that_the_car_is_in(mixed):
    others, steps = mixed.others, mixed.steps
    ended = steps.iloc[others.crashes["row"]]
    assert (ended["episode_status"] == "crashed").all()
    assert len(ended) == (mixed.episodes["status"] == "crashed").sum() > 0
    assert others.names[:3] == ("box 1", "box 2", "bot 1")
    placed = mixed.placed.on(mixed.course)
    for row, other in others.crashes[["row", "other"]].to_numpy()[:40]:
        drove = steps.iloc[row]
        poses, _ = rebuild_poses(
            mixed.placed.race,
            mixed.course,
            [placed[drove["episode"]]],
            1 / 15,
            np.zeros(1, np.intp),
            np.array([drove["steps"] - 1]),
        )
        away_m = np.hypot(*(poses[0, :, :2] - [drove["X"], drove["Y"]]).T)
        assert away_m[other] < 0.6


def test_a_report_of_a_run_among_others_begins_with_its_laps_without_a_crash(mixed):
    sections = draw_sections(LogPage(mixed, findings(mixed)))
    names = [chart.name for chart in sections[ON_ROAD]]
    assert names[:3] == ["crash_free", "crashes_by_object", "crash_places"]
    (found,) = [finding for finding in findings(mixed) if finding.rule == "costs_most"]
    assert "costs most" in found.sentence
    assert found.values["all_crashes"] >= found.values["crashes"] > 0


def test_a_run_alone_says_nothing_of_others(trained):
    view = prepare(read_run_recording(trained().folder))
    assert view.others is None
    assert all(draw(view) is None for draw in (crash_free, crash_places, crashes_by_object, overtakes))
    assert ON_ROAD not in draw_sections(LogPage(view, []))
    assert all(finding.rule != "costs_most" for finding in findings(view))


def test_a_car_that_drives_a_lap_passes_every_box_once_and_slower_bots():
    options = (
        "track=reInvent2019_track",
        "race=head_to_bot",
        "race.boxes.number=3",
        "observation.next_objects=1",
    )
    experiment = compose_experiment(options)[0]
    (track,) = directed_tracks(next(iter(experiment.tracks.values())))
    count, length_m = 120, track.length_m
    driven_m = 0.99 * length_m * np.arange(count) / count
    pose = track.start_pose(driven_m / length_m)
    steps = pd.DataFrame(
        {
            "episode": 7,
            "steps": np.arange(1, count + 1),
            "X": pose.x,
            "Y": pose.y,
            "yaw": np.degrees(pose.yaw_rad),
            "episode_status": "in_progress",
        }
    )
    # On the centre line, beside the first box; the last row is near nothing, so that nobody knows what it hit.
    beside = int(np.abs(driven_m - 3.0).argmin())
    steps.loc[[beside, count - 1], "episode_status"] = "crashed"
    places_m = np.array([3.0, 9.0, 14.0, *np.linspace(2, length_m - 1, 6)])
    drawn = Placement(places_m, np.arange(9) % 2, 3)
    placed = PlacedOthers(race=experiment.race, episodes={False: {7: drawn}}, period_s=1 / 15)
    found = others_on_road(placed, steps, track)
    assert found.corners.shape == (3, 4, 2)
    np.testing.assert_allclose(found.lap_share, places_m[:3] / length_m)
    passed = found.passes[found.passes["overtaken"]]
    assert passed["other"].value_counts().reindex(range(3)).tolist() == [1, 1, 1]
    rows = passed.set_index("other")["row"]
    np.testing.assert_allclose(driven_m[rows[[0, 1, 2]]], places_m[:3], atol=0.4)
    assert (passed["other"] >= 3).sum() >= 3
    assert found.crashes[["row", "other"]].to_numpy().tolist() == [[beside, 0]]
    sentence, values = costliest(found, np.ones(count, bool))
    assert values["all_crashes"] == 1
    assert sentence.startswith("Box 1 (at 13% of the lap) costs most: 1 of 1 crashes")
    assert costliest(found, np.zeros(count, bool)) is None
    # Another episode is not known.
    other = dataclasses.replace(placed, episodes={False: {8: drawn}})
    assert others_on_road(other, steps, track) is None


def test_a_log_whose_parameters_say_where_the_boxes_are_is_analysed_as_a_run_among_them(trained):
    fixed = (
        *("race=object_avoidance", "race.boxes.placement=fixed", "observation.next_objects=2"),
        "race.boxes.positions=[{lap: 0.3, lane: inner}, {lap: 0.6, lane: outer}]",
        "track=reInvent2019_track",
    )
    run = read_run_recording(trained(*fixed, *QUICK).folder)
    own = prepare(run)
    logged = dataclasses.replace(run.recording, race={"OBJECT_POSITIONS": "0.3,1;0.6,-1"})
    view = prepare(logged)
    pd.testing.assert_frame_equal(view.others.table(), own.others.table())
    assert own.others.table()["crashes"].sum() > 0
    np.testing.assert_allclose(view.others.corners, own.others.corners)
    np.testing.assert_allclose(view.others.lap_share, [0.3, 0.6])
    for unknown in ({}, {"NUMBER_OF_OBSTACLES": "3"}, {"OBJECT_POSITIONS": "here"}):
        assert prepare(dataclasses.replace(logged, race=unknown)).others is None


def test_each_crash_of_a_recorded_training_is_one_with_its_bot(reference, tmp_path):
    with tarfile.open(reference / "race_pace" / "console_v5_one_bot_ppo.tar.gz") as archive:
        archive.extractall(tmp_path, filter="data")
    params = {"NUMBER_OF_BOT_CARS": "1", "BOT_CAR_SPEED": "0.5", "IS_LANE_CHANGE": "False"}
    (tmp_path / "training_params.yaml").write_text(
        "".join(f'{key}: "{value}"\n' for key, value in params.items())
    )
    view = prepare(read_recording(tmp_path))
    assert len(view.others.crashes) == (view.episodes["status"] == "crashed").sum() == 15
    assert view.others.names == ("bot 1",)


def test_a_report_of_a_race_head_to_head_shows_the_rival_and_the_boxes(trained):
    options = ("race=head_to_head", "race.boxes.number=2", "observation.next_objects=2", "reward=overtake")
    view = prepare(read_run_recording(trained(*options, "track=reInvent2019_track", *QUICK).folder))
    others = view.others
    assert others.names == ("box 1", "box 2", "rival")
    ended = view.steps.iloc[others.crashes["row"]]
    crashed = view.episodes["status"] == "crashed"
    assert (ended["episode_status"] == "crashed").all()
    assert len(ended) == crashed.sum() > 0
    first = view.steps[view.steps["episode"] == 0]
    x, y = view.others_at(first)[:, -1].T
    # It starts 0.75 m ahead or behind in the other lane.
    assert 0.5 < np.hypot(x[0] - first["X"].iloc[0], y[0] - first["Y"].iloc[0]) < 1.5
    assert len(others.passes[others.passes["other"] == 2])
    sections = draw_sections(LogPage(view, findings(view)))
    (drawn,) = [chart for chart in sections[ON_ROAD] if chart.name == "overtakes"]
    assert "its rival" in drawn.caption
