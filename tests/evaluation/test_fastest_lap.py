import json
import warnings

import numpy as np
import pytest
from numba import njit

from deepracer_exp.commands.tracks import search_fastest
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.rules import lap_clock_s
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.evaluation.fastest import fastest_lap as fastest
from deepracer_exp.evaluation.fastest import lap_search
from deepracer_exp.evaluation.fastest.fastest_lap import FastestLap, Question, fastest_lap, kept_lap
from deepracer_exp.evaluation.fastest.lap_search import Search
from deepracer_exp.evaluation.fastest.optimal_control import Aim, _backward
from deepracer_exp.tracks.track import Track

FAST = ("action_space=continuous", "action_space.speed.low=0.1", "action_space.speed.high=4")


def ring(radius_m=1.2, width_m=0.7):
    angle = np.linspace(0, 2 * np.pi, 61)
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    unit[-1] = unit[0]  # closed
    radii = (radius_m, radius_m - 0.5 * width_m, radius_m + 0.5 * width_m)
    return Track.from_route(np.concatenate([unit * radius for radius in radii], axis=1), "ring")


def question(*overrides, track=None):
    return Question.of(compose_experiment([*FAST, *overrides])[0], track or ring())


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="module")
def lap(cache) -> FastestLap:
    return fastest_lap(question())


def test_the_environment_times_the_lap_by_the_services_clock(lap):
    assert lap.lap_time_s == pytest.approx(float(lap_clock_s(len(lap.steps), 1 / 15)))
    assert lap.column("progress")[-1] == 100.0
    assert lap.column("speed_mps")[0] == 0.0


def test_no_lap_is_below_its_bound_and_the_bound_is_near(lap):
    assert lap.over_bound >= 0.0
    # A lap of two seconds has 30 control periods.
    assert lap.lap_time_s - lap.bound_s < 4.5 / 15


def test_the_lap_is_faster_than_the_inner_border_at_a_steady_speed(lap):
    # 0.85 m inside, held at 2.6 m/s, and a start that takes 0.3 s.
    assert lap.lap_time_s < 2 * np.pi * 0.85 / 2.6 + 0.3


def test_commands_stay_within_the_limits(lap):
    assert np.abs(lap.column("steering_deg")).max() <= 30.0 + 1e-9
    assert lap.column("commanded_mps").max() <= 4.0 + 1e-9


@pytest.mark.parametrize(
    "overrides",
    [
        ("observation=camera_small", "network=cnn_small"),
        ("race=object_avoidance", "race.boxes.number=1", "observation.next_objects=1"),
    ],
    ids=" ".join,
)
def test_the_lap_of_a_run_among_others_or_with_a_camera_is_driven_alone_and_blind(lap, overrides):
    commands = np.column_stack([lap.column("commanded_mps"), np.radians(lap.column("steering_deg"))])
    np.testing.assert_allclose(question(*overrides)._drive(commands[1:-1]), lap.steps, atol=1e-9)


def test_a_lap_is_searched_once(lap, cache, monkeypatch):
    monkeypatch.setattr(Question, "answer", lambda *_: pytest.fail("searched again"))
    again = fastest_lap(question())
    assert again.lap_time_s == lap.lap_time_s
    assert (again.steps == lap.steps).all()


@pytest.mark.parametrize("text", ["", "{}", '{"lap_time_s": 1, "bound_s": 1, "steps": [[1]]}', "[1]"])
def test_a_corrupt_file_counts_as_none(lap, cache, text):
    (file,) = cache.rglob(f"{question().key}.json")
    content = file.read_text()
    file.write_text(text)
    assert kept_lap(question()) is None
    file.write_text(content)
    kept = kept_lap(question())
    assert kept is not None
    assert json.loads(content)["columns"] == list(fastest.COLUMNS)


def test_the_lap_of_the_default_car_on_the_default_track_needs_no_search(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    experiment = compose_experiment([])[0]
    (config,) = experiment.tracks.values()
    kept = kept_lap(Question.of(experiment, Track.from_config(config, reversed=False)))
    assert kept is not None
    assert kept.bound_s <= kept.lap_time_s == pytest.approx(float(lap_clock_s(len(kept.steps), 1 / 15)))
    assert kept.column("progress")[-1] == 100.0


def test_the_lap_depends_on_track_car_and_limits():
    others = (
        question("car=deepracer_v5"),
        question("action_space.speed.high=3"),
        question(track=ring(1.3)),
    )
    assert len({question().key, *(other.key for other in others)}) == 4


def test_a_list_of_actions_counts_with_the_box_of_its_limits():
    listed = Question.of(compose_experiment(["action_space=discrete"])[0], ring())
    box = ("action_space.speed.low=1", "action_space.speed.high=3")
    assert listed.key == question(*box).key


@pytest.fixture
def searched_once(monkeypatch):
    """Search in one pass instead of three: a lap that may be slower, in a third of the time."""
    monkeypatch.setattr(lap_search, "PASSES", lap_search.PASSES[:1])


@pytest.mark.usefixtures("searched_once")
def test_slower_commands_are_slower(lap, cache):
    slow = fastest_lap(question("action_space.speed.high=2"))
    assert slow.lap_time_s > lap.lap_time_s + 0.3
    assert slow.column("speed_mps").max() < 2.05


@pytest.mark.usefixtures("searched_once")
def test_an_open_course_is_driven_to_its_end(cache):
    x = np.linspace(0.0, 4.0, 21)
    rows = np.column_stack([x, 0 * x, x, 0 * x + 0.4, x, 0 * x - 0.4])
    found = fastest_lap(question(track=Track.from_route(rows, "open")))
    assert 1.2 < found.lap_time_s < 1.8
    assert found.column("progress")[-1] == 100.0


def test_a_lap_through_tight_bends_is_near_its_bound(cache):
    # Searched once and at a single speed of the guesses, a lap of this course is a third above its bound.
    x = np.linspace(0.0, 4.0, 81)
    centre = np.column_stack([x, 1.25 * (1.0 - np.cos(0.5 * np.pi * x))])
    ahead = np.gradient(centre, axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.hypot(*ahead.T)[:, None]
    rows = np.concatenate([centre, centre + 0.4 * left, centre - 0.4 * left], axis=1)
    found = fastest_lap(question(track=Track.from_route(rows, "bends")))
    assert found.over_bound < 0.1
    assert found.column("progress")[-1] == 100.0


@pytest.mark.usefixtures("searched_once")
def test_limits_that_no_lap_fits_into_are_said_in_one_line(cache):
    with pytest.raises(RunFailed, match="ring: no lap was found that stays on the road with"):
        fastest_lap(question("action_space.steering_angle.low=-3", "action_space.steering_angle.high=3"))


def test_a_command_that_cannot_be_chosen_is_refused():
    with pytest.raises(BadInput, match="speed is always 2"):
        question("action_space.speed.low=2", "action_space.speed.high=2")


def test_without_a_terminal_a_search_prints_what_it_searches_and_each_tenth(
    lap, capsys, monkeypatch, tmp_path
):
    def answer(_, on_round):
        for share, lap_time_s in ((0.01, None), (0.11, None), (0.15, None), (0.52, 2.5), (1.0, 2.25)):
            on_round(share, lap_time_s)
        return lap

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(Question, "answer", answer)
    search_fastest(compose_experiment(FAST)[0], ring())
    first, *lines = capsys.readouterr().err.splitlines()
    assert first.startswith("searching the fastest lap of deepracer_v6 on ring in 3 rounds")
    assert lines == ["  11%: no lap yet", "  52%: 2.500 s so far", "  100%: 2.250 s so far"]


@pytest.mark.slow  # whatever else is compiled during the tests fails by the same warning: `filterwarnings`
def test_the_search_is_compiled_without_a_warning():
    asked, periods = question(), 2
    search = Search(asked.experiment.car, asked.track, np.array([0.1, -0.5]), np.array([4.0, 0.5]))
    states, commands = np.zeros((periods + 1, 15)), np.zeros((periods, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        aim = Aim(np.array([[0.1, -0.5], [4.0, 0.5]]), np.zeros(periods + 1), 100.0, np.ones(2))
        derivatives = np.zeros((periods, 15, 15)), np.zeros((periods, 15, 2))
        changes = np.zeros((periods, 2)), np.zeros((periods, 2, 15))
        njit(_backward.py_func)(search._problem(0.0), (states, commands), aim, 1.0, derivatives, changes)
