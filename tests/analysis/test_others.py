"""Crashes and passes of a run among boxes and bots, told from its trace and where the others were."""

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.analysis.charts.others import crash_free, crash_places, crashes_by_object, overtakes
from deepracer_exp.analysis.findings import findings
from deepracer_exp.analysis.log_view import prepare
from deepracer_exp.analysis.others import costliest, others_on_road
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.placement import Placement, rebuild_poses
from deepracer_exp.reports.log_report import LogPage, draw_sections
from deepracer_exp.runs.recording import read_run_recording
from deepracer_exp.tracks.track import directed_tracks

ON_ROAD = "What is on the road"
MIXED = (
    *("race=head_to_bot", "race.boxes.number=2", "observation.next_objects=2"),
    "track=reInvent2019_track",
)


@pytest.fixture(scope="module")
def mixed(trained):
    return prepare(read_run_recording(trained(*MIXED).folder))


def test_every_crash_of_a_run_has_the_box_or_bot_that_the_car_is_in(mixed):
    others, steps = mixed.others, mixed.steps
    ended = steps.iloc[others.crashes["row"]]
    assert (ended["episode_status"] == "crashed").all()
    assert len(ended) == (mixed.episodes["status"] == "crashed").sum() > 0
    assert others.names[:3] == ("box 1", "box 2", "bot 1")
    placed = mixed.run.placed[False]
    for row, other in others.crashes[["row", "other"]].to_numpy()[:40]:
        drove = steps.iloc[row]
        poses, _ = rebuild_poses(
            mixed.run.race,
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
    steps.loc[count - 1, "episode_status"] = "crashed"
    places_m = np.array([3.0, 9.0, 14.0, *np.linspace(2, length_m - 1, 6)])
    drawn = Placement(places_m, np.arange(9) % 2, 3)
    found = others_on_road(experiment.race, {7: (drawn, np.zeros(0))}, steps, track, 1 / 15)
    assert found.corners.shape == (3, 4, 2)
    np.testing.assert_allclose(found.lap_share, places_m[:3] / length_m)
    passed = found.passes[found.passes["overtaken"]]
    assert passed["other"].value_counts().reindex(range(3)).tolist() == [1, 1, 1]
    rows = passed.set_index("other")["row"]
    np.testing.assert_allclose(driven_m[rows[[0, 1, 2]]], places_m[:3], atol=0.4)
    assert (passed["other"] >= 3).sum() >= 3
    assert found.crashes["row"].tolist() == [count - 1]
    sentence, values = costliest(found, np.ones(count, bool))
    assert values["all_crashes"] == 1
    assert sentence.startswith(found.names[found.crashes["other"][0]].capitalize())
    assert costliest(found, np.zeros(count, bool)) is None
    # Another episode is not known.
    assert others_on_road(experiment.race, {8: (drawn, np.zeros(0))}, steps, track, 1 / 15) is None
