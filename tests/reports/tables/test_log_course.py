"""Which course a recording was driven on, whatever it calls it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.aws.logs.recorded import Recording
from deepracer_exp.aws.worlds.routes import world_rows
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.reports.tables.log_course import catalogue_track, find_courses, numbered_as_logged
from deepracer_exp.reports.tables.log_view import prepare
from deepracer_exp.tracks.sectors import sectors_of

from .made_up import Drive, made_up_course, made_up_recording


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
    tracks, problems = find_courses(renamed(made_up_recording([Drive()]), name))
    assert (tracks[name].name, problems) == ("reinvent_base", ())


@pytest.mark.parametrize(
    ("world", "logged"),
    [
        ("2022_reinvent_champ", "2022_reinvent_champ"),
        ("2022_reinvent_champ", ""),
        ("2022_reinvent_champ_ccw", ""),
        ("Canada_Eval", ""),
        ("Mexico_track_eval", "Mexico_track_eval"),
        # Until 2020 the service called it that.
        ("reinvent_base_2019", "reinvent_base"),
        ("reinvent_base_2019", ""),
        ("reinvent_wood", "reinvent_wood"),
    ],
)
def test_a_world_is_recognised_with_its_own_waypoint_numbers(world: str, logged: str) -> None:
    recording = renamed(made_up_recording([Drive(), Drive(start=0.4)], course=world), logged)
    tracks, problems = find_courses(recording)
    assert (tracks[logged].name, problems) == (world, ())
    # Both waypoints around the car would do for a world with as many waypoints elsewhere.
    found = tracks[logged].project(recording.steps[["X", "Y"]].to_numpy())
    assert (np.isin(recording.steps["closest_waypoint"], (found.previous, found.next))).all()


ALL_AROUND = [Drive(offset_m=side) for side in (-0.34, -0.2, 0.0, 0.2, 0.34)]


@pytest.mark.parametrize("name", ["", "2024_reinvent_champ"])
@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("world", ["2024_reinvent_champ_ccw", "2022_summit_speedway_ccw"])
def test_a_world_recognised_by_its_shape_has_the_borders_of_the_log(
    world: str, every: int, name: str
) -> None:
    """The two have one centre line; with every second number neither has the log's waypoints."""
    recording = renamed(made_up_recording(ALL_AROUND, course=world), name)
    steps = recording.steps.assign(closest_waypoint=recording.steps["closest_waypoint"] // every)
    tracks, problems = find_courses(replace(recording, steps=steps))
    assert tracks[name].width_m == pytest.approx(catalogue_track(world).width_m, abs=1e-3)
    assert problems == ()


def test_a_course_as_wide_as_no_world_of_its_shape_is_reported() -> None:
    recording = renamed(made_up_recording(ALL_AROUND, course="Vegas_track"), "")
    narrow = (
        np.abs(catalogue_track("Vegas_track").project(recording.steps[["X", "Y"]].to_numpy()).offset_m) < 0.3
    )
    tracks, problems = find_courses(
        replace(recording, steps=recording.steps.assign(all_wheels_on_track=narrow))
    )
    assert tracks[""].name == "Vegas_track"
    assert "has the shape of Vegas_track, but 4" in problems[0].reason


@pytest.mark.parametrize(
    ("file", "world"),
    [
        ("console_v5_baseline.tar.gz", "2022_reinvent_champ_ccw"),
        ("console_v5_v3.tar.gz", "Spain_track"),
        ("droa_v6_continuous.tar.gz", "reInvent2019_wide_cw"),
        ("drfc_v5_2022_june_pro.log.gz", "2022_june_pro"),
    ],
)
def test_a_recording_of_the_service_has_the_borders_of_its_world(
    reference: Path, file: str, world: str
) -> None:
    tracks, problems = find_courses(renamed(read_recording(reference / "race_pace" / file), ""))
    assert (tracks[""].name, problems) == (world, ())


def test_wheels_that_are_logged_a_step_late_say_nothing_of_the_width(reference: Path) -> None:
    log = reference / "inputs/fourth/04-late-wheels/made-up-robomaker.log"
    recording = read_recording(log)
    tracks, problems = find_courses(recording)
    assert (tracks["reinvent_base"].name, problems) == ("reinvent_base_2019", ())
    # By the clock of a simulation, which was paused, it would be another width.
    paused = recording.steps.assign(tstamp=recording.steps["tstamp"] - recording.steps["tstamp"].min())
    (problem,) = find_courses(replace(recording, steps=paused))[1]
    assert "its width may be another" in problem.reason


def test_a_course_driven_against_its_waypoints_is_turned_around() -> None:
    recording = made_up_recording([Drive()])
    steps = recording.steps
    # The same way back: time and progress run on, places run backwards.
    back = steps.assign(
        **{name: steps[name].to_numpy()[::-1] for name in ("X", "Y")}, yaw=steps["yaw"] + 180.0
    )
    view = prepare(replace(recording, steps=back))
    assert view.course.reversed
    assert view.steps["skew_deg"].abs().max() < 10.0


def elsewhere(recording: Recording) -> Recording:
    """Return the recording 100 m away from every world, of a name that none has."""
    moon = renamed(recording, "moon")
    return replace(moon, steps=moon.steps.assign(X=moon.steps["X"] + 100.0))


def test_an_unknown_course_is_reported_and_drawn_from_the_recorded_positions() -> None:
    around = elsewhere(made_up_recording([Drive(offset_m=side) for side in (-0.2, 0.0, 0.2)]))
    (problem,) = find_courses(around)[1]
    assert "'moon' is none of the service's 134 worlds (17.709 m long)" in problem.reason
    assert "`--track ROUTE` takes the file of its route (.npy)" in problem.reason
    view, known = prepare(around), made_up_course()
    assert "drawn from recorded positions" in view.course.title
    assert view.course.length_m == pytest.approx(known.length_m, rel=0.05)
    off_m = view.course.project(known.waypoints + np.array([100.0, 0.0])).offset_m
    assert np.abs(off_m).max() < 0.1
    # Half of the road is not: the car must have come all around.
    assert prepare(elsewhere(made_up_recording([Drive(until=0.5)]))).course is None


def test_a_route_given_by_hand_takes_the_place_of_an_unknown_course(tmp_path: Path) -> None:
    route = world_rows("reinvent_base") + np.array([100.0, 0.0] * 3)
    np.save(tmp_path / "moon_route.npy", route)
    view = prepare(elsewhere(made_up_recording([Drive()])), str(tmp_path / "moon_route.npy"))
    assert (view.course.name, view.problems) == ("moon_route", ())
    assert view.steps["offset_m"].abs().max() < 1e-3


@pytest.mark.parametrize("every", [2, 3])
def test_a_page_has_the_waypoint_numbers_of_its_log_wherever_it_has_any(every: int) -> None:
    recording = made_up_recording([Drive(start=0.3), Drive()])
    last = len(made_up_course().waypoints) - 1
    steps = recording.steps.assign(closest_waypoint=recording.steps["closest_waypoint"] // every)
    view = prepare(replace(recording, steps=steps))
    assert len(view.course.waypoints) == pytest.approx(last / every + 1, abs=2)
    found = view.course.project(steps[["X", "Y"]].to_numpy())
    logged = steps["closest_waypoint"].to_numpy()
    near = (np.abs(logged - found.previous) <= 1) | (np.abs(logged - found.next) <= 1)
    assert near.mean() > 0.95
    assert max(part.last_waypoint for part in sectors_of(view.course)) <= logged.max() + 1
    assert view.course.length_m == pytest.approx(made_up_course().length_m, rel=0.03)


@pytest.mark.parametrize("backwards", [False, True])
def test_a_course_with_the_numbers_of_a_log_is_driven_in_the_same_direction(backwards: bool) -> None:
    course, ndist = catalogue_track("reinvent_base", backwards), np.linspace(0.0, 0.999, 1000)
    points = course.points_at(ndist)
    logged = course.project(points).previous // 2
    steps = pd.DataFrame({"X": points[:, 0], "Y": points[:, 1], "closest_waypoint": logged})
    numbered = numbered_as_logged(course, steps)
    assert (numbered.reversed, numbered.is_clockwise) == (backwards, course.is_clockwise)
    found = numbered.project(points)
    assert (np.minimum(np.abs(logged - found.previous), np.abs(logged - found.next)) <= 1).mean() > 0.95
    # The first number is half a spacing further than in the course.
    assert np.abs((found.ndist - ndist + 0.5) % 1.0 - 0.5).max() < 0.02


def test_of_several_courses_the_most_driven_one_is_shown_unless_another_is_asked_for() -> None:
    one, other = made_up_recording([Drive()] * 2), made_up_recording([Drive()], course="Oval_track")
    both = replace(one, steps=pd.concat([one.steps, other.steps.assign(episode=2)], ignore_index=True))
    assert (prepare(both).track_name, len(prepare(both).episodes)) == ("reinvent_base", 2)
    oval = prepare(both, "Oval_track")
    assert (oval.track_name, oval.course and oval.course.name) == ("Oval_track", "Oval_track")
    with pytest.raises(BadInput, match=r"Monaco was not driven on; accepted: reinvent_base, Oval_track"):
        prepare(both, "Monaco")


def test_a_track_of_races_only_can_be_asked_for() -> None:
    one, other = made_up_recording([Drive()]), made_up_recording([Drive()] * 3, course="Oval_track")
    raced = other.steps.assign(stream="race")
    view = prepare(replace(one, steps=pd.concat([one.steps, raced], ignore_index=True)), "Oval_track")
    assert (view.track_name, view.trained, len(view.episodes)) == ("Oval_track", False, 3)


@pytest.mark.parametrize("name", ["reinvent_base", ""])
def test_another_track_than_the_one_driven_on_is_refused(name: str) -> None:
    recording = renamed(made_up_recording([Drive()]), name)
    with pytest.raises(BadInput, match=r"track=Bowtie_track was not driven on; accepted: reinvent_base"):
        prepare(recording, "Bowtie_track")
    assert prepare(recording, "reinvent_base").course is not None


def test_a_run_of_ours_has_its_courses_in_its_configuration(tmp_path: Path) -> None:
    knots = catalogue_track("Oval_track").waypoints[:-1:4].tolist()
    overrides = ["track.name=mine", f"track.knots={knots}".replace(" ", ""), "track.width_m=0.67"]
    (tmp_path / "config.yaml").write_text(compose_experiment(overrides)[1].yaml(), encoding="utf-8")
    recording = replace(
        renamed(made_up_recording([Drive()], course="Oval_track"), "mine"), files=(tmp_path / "config.yaml",)
    )
    assert find_courses(recording)[0]["mine"].name == "mine"


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(
        BadInput, match=r"--track reinvnt_base: no such world \(did you mean reinvent_base\?\)"
    ):
        catalogue_track("reinvnt_base")
