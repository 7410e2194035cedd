import os

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.options import conf_dir, conf_dirs, groups, options
from deepracer_exp.errors import BadInput, nearest

BUDGET = "defaults: [default, _self_]\nenv_steps: 777\n"


def test_options_of_the_working_folder_stand_beside_the_projects(own):
    before = options("budget")
    own("budget/mine.yaml", BUDGET)
    own("budget/other.yaml", "defaults: [short]\niterations: 3\n")
    assert options("budget") == sorted([*before, "mine", "other"])
    experiment, composition = compose_experiment(["budget=mine"])
    assert (experiment.budget.env_steps, composition.choices["budget"]) == (777, "mine")
    budget = compose_experiment(["budget=other"])[0].budget
    assert (budget.env_steps, budget.iterations) == (200_000, 3)


def test_the_nearest_of_all_options_is_reported(own):
    own("budget/mine_all.yaml", BUDGET)
    with pytest.raises(BadInput, match=r"did you mean mine_all\?.*long, mine_all, short"):
        compose_experiment(["budget=mine_al"])


@pytest.mark.parametrize("is_link", [False, True])
def test_an_option_is_composed_as_it_is_now(here, own, is_link):
    (here / "elsewhere").mkdir()
    (here / "conf").mkdir()
    if is_link:
        (here / "conf" / "budget").symlink_to(here / "elsewhere")
    for second, steps in ((1, 2001), (2, 3002), (3, 3002)):  # of the same length
        file = own("budget/mine.yaml", f"defaults: [default, _self_]\nenv_steps: {steps}\n")
        os.utime(file, (second, second))  # some file systems count whole seconds
        assert compose_experiment(["budget=mine"])[0].budget.env_steps == steps
        assert compose_experiment(["budget=mine", "budget.env_steps=7"])[0].budget.env_steps == 7
        assert compose_experiment(["budget=mine"])[0].budget.env_steps == steps


def test_a_namesake_that_is_not_the_same_is_refused_whatever_is_chosen(own):
    path = own("budget/short.yaml", (conf_dir() / "budget/short.yaml").read_text())
    assert len(compose_experiment([])[0].name) > 0
    path.write_text(BUDGET)
    with pytest.raises(
        BadInput, match=r"conf/budget/short\.yaml: the project has another budget of that name"
    ):
        compose_experiment([])
    with pytest.raises(BadInput, match="rename the file"):
        options("track")


def test_the_projects_own_folder_is_searched_once(here, monkeypatch):
    (here / "conf").write_text("a file of that name")
    assert conf_dirs() == [conf_dir().resolve()]
    monkeypatch.chdir(conf_dir().parent)
    assert conf_dirs() == [conf_dir().resolve()]


def test_a_conf_folder_of_something_else_does_no_harm(here, own):
    before = groups()
    own("train.yaml", "seed: 99\n")
    own("database/x.yaml", "a: 1\n")
    (here / "conf/budget").write_text("a file")
    assert groups() == before
    assert compose_experiment([])[0].seed == 0


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("reinvent", "reinvent_base"),
        ("OVAL", "Oval_track"),
        ("champ", "2022_reinvent_champ"),
        ("reinvnt_wod", "reinvent_wood"),
        ("moon", None),
        ("", None),
    ],
)
def test_what_begins_with_a_word_is_nearer_than_what_looks_like_it(word, meant):
    assert nearest(word, options("track")) == (f" (did you mean {meant}?)" if meant else "")


COURSE = "width_m: 0.76\nknots: [[0, 0], [4, 0], [4, 3], [0, 3]]\n"


def test_a_track_of_ones_own_needs_no_more_than_knots_and_a_width(own):
    own("track/mine.yaml", COURSE)
    overrides = ["track.direction=reversed", "track.floor.friction=0.5"]
    track = compose_experiment(["track=mine", *overrides])[0].track
    assert (track.name, track.title, track.width_m, track.closed) == ("mine", "mine", 0.76, True)
    assert (track.direction, track.floor.friction, track.floor.road_color) == ("reversed", 0.5, "#263344")
    several = compose_experiment(["track=[mine,Oval_track]", "track.mine.weight=2"])[0].tracks
    assert [(track.name, track.weight) for track in several.values()] == [("mine", 2), ("Oval_track", 1)]
    assert "mine" in compose_experiment(["track=all"])[0].tracks
    own("track/Oval_track.yaml", COURSE)
    with pytest.raises(BadInput, match=r"Oval_track\.yaml: the project has another track of that name"):
        compose_experiment([])
