"""Which course a recording was driven on, whatever it calls it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.analysis.log_course import catalogue_track, find_courses
from deepracer_exp.analysis.log_view import prepare
from deepracer_exp.config.options import options
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.recording import Recording

from .made_up import Drive, made_up_recording


def renamed(recording: Recording, name: str) -> Recording:
    return replace(
        recording,
        steps=recording.steps.assign(track=pd.Categorical([name] * len(recording.steps))),
        track=None,
    )


@pytest.mark.parametrize(
    "name", ["REINVENT_BASE", "arn:aws:deepracer:us-east-1::track/reinvent_base", "", "my_copy"]
)
def test_a_course_is_found_by_its_name_or_by_where_the_car_drove(name: str) -> None:
    found = find_courses(renamed(made_up_recording([Drive()]), name))
    assert found.tracks[name].name == "reinvent_base"
    assert not found.problems


def test_a_course_driven_against_its_waypoints_is_turned_around() -> None:
    recording = made_up_recording([Drive()])
    steps = recording.steps
    # The same way back: time and progress run on, places run backwards.
    back = steps.assign(
        **{name: steps[name].to_numpy()[::-1] for name in ("X", "Y")}, yaw=steps["yaw"] + 180.0
    )
    view = prepare(replace(recording, steps=back))
    assert view.course is not None
    assert view.course.reversed
    assert view.steps["skew_deg"].abs().max() < 10.0


def test_a_course_that_is_nowhere_known_is_left_out_with_a_reason() -> None:
    recording = renamed(made_up_recording([Drive()]), "moon")
    found = find_courses(replace(recording, steps=recording.steps.assign(X=recording.steps["X"] + 100.0)))
    assert not found.tracks
    assert "'moon' is none of the catalogue (17.695 m long)" in str(found.problems[0])


def test_an_unknown_course_still_has_lap_positions_from_progress() -> None:
    recording = renamed(made_up_recording([Drive(start=0.25)]), "moon")
    view = prepare(replace(recording, steps=recording.steps.assign(X=recording.steps["X"] + 100.0)))
    expected = (0.25 + view.steps["progress"] / 100.0) % 1.0
    apart = np.abs(view.steps["lap_position"] - expected)
    assert np.minimum(apart, 1.0 - apart).max() < 0.02
    assert view.steps["offset_m"].isna().all()


def test_of_several_courses_the_most_driven_one_is_shown_unless_another_is_asked_for() -> None:
    one, other = made_up_recording([Drive()] * 2), made_up_recording([Drive()], course="Oval_track")
    both = replace(one, steps=pd.concat([one.steps, other.steps.assign(episode=2)], ignore_index=True))
    assert (prepare(both).track_name, len(prepare(both).episodes)) == ("reinvent_base", 2)
    oval = prepare(both, "Oval_track")
    assert (oval.track_name, oval.course and oval.course.name) == ("Oval_track", "Oval_track")
    with pytest.raises(BadInput, match=r"Monaco was not driven on; accepted: reinvent_base, Oval_track"):
        prepare(both, "Monaco")


def test_a_run_of_ours_has_its_courses_in_its_configuration(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "conf/track/Oval_track.yaml").read_text(encoding="utf-8")
    lines = [line for line in text.replace("name: Oval_track", "name: mine").splitlines() if line[:1] != "#"]
    (tmp_path / "config.yaml").write_text(
        "track:\n" + "\n".join(f"  {line}" for line in lines), encoding="utf-8"
    )
    recording = replace(
        renamed(made_up_recording([Drive()], course="Oval_track"), "mine"), files=(tmp_path / "config.yaml",)
    )
    assert find_courses(recording).tracks["mine"].name == "mine"


def test_every_course_of_the_catalogue_can_be_built() -> None:
    for name in options("track"):
        assert catalogue_track(name).name == name


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(BadInput, match=r"track=moon: no such track; accepted: .*reinvent_base"):
        catalogue_track("moon")
