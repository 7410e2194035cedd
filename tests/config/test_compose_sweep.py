import dataclasses
import re
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.addresses import with_password
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.dimension import Choices, Range, as_override, dimension, override_value
from deepracer_exp.config.options import conf_dir, options, project_dir, sweep_files
from deepracer_exp.config.overrides import parse_single
from deepracer_exp.config.sweep import SweepConfig, SweepEntry, compose_sweep
from tests.conftest import refused

READY = [name for name in options("sweep") if name != "own"]
FILES = [conf_dir() / "sweep.yaml", *sweep_files().values(), conf_dir() / "sweep/executor/local.yaml"]


@pytest.fixture
def study(here):
    """Write a study into the working folder."""

    def write(name: str, text: str) -> Path:
        path = here / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    return write


def refusal(*overrides: str) -> str:
    return refused(compose_sweep, overrides)


# --- The files


@pytest.mark.parametrize("name", options("sweep"))
def test_every_ready_made_sweep_has_the_keys_of_its_dataclass(name):
    request = compose_sweep([f"sweep={name}"])
    mapping = request.composition.mapping
    assert set(mapping) == {field.name for field in dataclasses.fields(SweepEntry)}
    assert set(mapping["sweep"]) == {field.name for field in dataclasses.fields(SweepConfig)}
    assert request.composition.choices == {"sweep": name, "sweep/executor": "local"}
    assert request.space.keys() == mapping["sweep"]["space"].keys()
    assert bool(request.space) == (name != "own")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_key_is_explained(file):
    lines = file.read_text().splitlines()
    for above, line in zip(["", *lines], lines, strict=False):
        if re.match(r"(?!defaults)\w+:", line):
            assert above.startswith("#"), f"{file}: {line} has no comment above it"


@pytest.mark.parametrize("name", READY)
def test_every_ready_made_study_begins_with_the_question_that_it_answers(name):
    comment = re.match(r"(?:#.*\n)+", sweep_files()[name].read_text())
    assert "?" in comment.group()


def test_a_study_of_the_working_folder_may_build_on_a_ready_made_one(study):
    study("sweeps/mine.yaml", "defaults: [lr_entropy, _self_]\ntrials: 7\n")
    study("conf/sweep/other.yaml", "defaults: [mine, _self_]\nseeds: 2\n")
    ready, mine, other = (compose_sweep([f"sweep={name}"]) for name in ("lr_entropy", "mine", "other"))
    assert mine.space == other.space == ready.space
    assert mine.entry.sweep == dataclasses.replace(ready.entry.sweep, trials=7)
    assert other.entry.sweep == dataclasses.replace(mine.entry.sweep, seeds=2)
    assert (mine.study, other.study) == ("mine", "other")
    assert options("sweep") == sorted([*READY, "own", "mine", "other"])


@pytest.mark.parametrize("folder", ["sweeps", "conf/sweep"])
@pytest.mark.parametrize("name", ["lr_entropy", "own"])
def test_a_study_with_the_name_of_another_one_is_refused(study, folder, name):
    text = sweep_files()[name].read_text()
    file = study(f"{folder}/{name}.yaml", text)
    compose_sweep(["sweep=network"])
    file.write_text("trials: 3\n")
    assert f"{folder}/{name}.yaml" in refusal("sweep=network")
    file.unlink()
    study("sweeps/mine.yaml", text)
    study("conf/sweep/mine.yaml", "trials: 3\n")
    assert "conf/sweep/mine.yaml: sweeps/mine.yaml has the same name" in refusal("sweep=network")


def test_a_study_that_cannot_be_read_is_refused_by_its_file(study):
    study("sweeps/mine.yaml", "trials: [\n")
    assert "sweeps/mine.yaml" in refusal("sweep=mine")
    compose_sweep(["sweep=network"])


def test_trials_are_judged_by_twenty_laps_on_both_conditions():
    protocol = compose_experiment([f"evaluation={compose_sweep([]).entry.sweep.protocol}"])[0].evaluation
    assert (protocol.trials, protocol.usual, protocol.held_out) == (20, "none", "sim2real")


# --- What is whose


def test_overrides_are_of_the_sweep_of_every_trial_or_searched():
    request = compose_sweep(
        [
            *("study=mine", "sweep.trials=7", "sweep/executor=local", "parent=best:a b", "debug=true"),
            *("track=Oval_track", "algorithm.lr=tag(log, interval(1e-5, 1e-3))", "network=mlp,mlp_deep"),
        ]
    )
    entry = request.entry
    assert (entry.study, entry.parent, entry.debug, entry.sweep.trials) == ("mine", "best:a b", True, 7)
    assert request.base == ("track=Oval_track",)
    assert request.space == {"algorithm.lr": "tag(log, interval(1e-5, 1e-3))", "network": "mlp,mlp_deep"}


def test_a_study_is_named_after_the_ready_made_sweep_unless_it_has_a_name():
    assert compose_sweep(["sweep=network"]).study == "network"
    assert compose_sweep(["seed=3"]).study == "sweep"
    assert compose_sweep(["sweep=network", "study=2024"]).study == "2024"


def test_the_address_of_a_database_needs_no_quotes():
    address = "postgresql+psycopg://racer:p,w=(1)@host:5432/db?sslmode=require&x=1"
    stored = compose_sweep([f"sweep.storage={address}"]).entry.sweep.storage
    assert stored == address.replace(":p,w=(1)", "")
    assert with_password(stored) == address


def test_the_command_line_takes_the_place_of_what_a_ready_made_sweep_searches():
    ready = yaml.safe_load((project_dir("sweeps") / "lr_entropy.yaml").read_text())["space"]
    request = compose_sweep(
        ["sweep=lr_entropy", "algorithm.lr=0.001", "algorithm.entropy_coeff=0.01,0.02", "budget=short"]
    )
    assert "algorithm.lr" in ready
    assert request.space == {"algorithm.entropy_coeff": "0.01,0.02"}
    assert request.base[-2:] == ("algorithm.lr=0.001", "budget=short")


def test_the_command_line_takes_the_place_of_what_a_ready_made_sweep_fixes():
    request = compose_sweep(["sweep=lr_entropy", "budget.env_steps=10000,20000", "collector=sync"])
    assert request.base == ("stopping=impatient", "collector=sync")
    assert request.space["budget.env_steps"] == "10000,20000"


def test_the_last_of_two_overrides_counts_whether_it_fixes_or_searches():
    assert compose_sweep(["algorithm.lr=0.1,0.2", "algorithm.lr=0.3"]).space == {}
    request = compose_sweep(["algorithm.lr=0.3", "+algorithm.lr=0.1,0.2"])
    assert request.space == {"algorithm.lr": "0.1,0.2"}
    assert request.base == ()


def test_a_key_is_left_out_of_the_search_by_a_tilde():
    request = compose_sweep(["sweep=lr_entropy", "~algorithm.lr"])
    assert list(request.space) == ["algorithm.entropy_coeff"]
    assert not any("algorithm.lr" in line for line in request.base)


def test_ready_made_keys_of_a_group_chosen_on_the_command_line_are_optional():
    request = compose_sweep(
        ["sweep=everything", "action_space=grid", "action_space.speed_levels=2,3", "network=mlp,mlp_deep"]
    )
    of_both = {key for key in request.space if key.startswith(("action_space.", "network."))}
    assert request.optional == of_both - {"action_space.speed_levels"}
    assert compose_sweep(["sweep=everything"]).optional == frozenset()


def test_an_options_pattern_stands_for_the_options_of_today():
    request = compose_sweep(["network=glob([mlp_*], exclude=*_shared)"])
    assert request.space == {"network": "choice(mlp_deep,mlp_small)"}
    assert dimension("track", "glob(*summit_speedway)") == Choices(("2022_summit_speedway",))


# --- What is refused


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("sweep.workers=0", ["sweep.workers=0", "greater than or equal to 1"]),
        ("sweep.trials=0", ["sweep.trials=0", "greater than or equal to 1"]),
        ("sweep.trails=3", ["sweep.trails: no such key", "did you mean trials?"]),
        ("sweep=lr_entropi", ["no such sweep (did you mean lr_entropy?)"]),
        ("sweep/executor=loca", ["no such sweep/executor (did you mean local?)"]),
        ("sweep.protocol=three_trial", ["no such evaluation (did you mean three_trials?)"]),
        ("sweep.sampler=tpe2", ["sweep.sampler", "accepted: tpe, gp, cmaes"]),
        ("sweep.sampler=tpe,gp", ["accepted: one value"]),
        ("sweep.pruners=entropy,median", ["sweep.pruners=[entropy,median]"]),
        ("sweep.pruners=[entropy,entropy]", ["listed twice"]),
        ("sweep.objectives=[]", ["sweep.objectives"]),
        ("sweep.space.seed=1", ["write the key itself"]),
        ("study=a/b", ["letters, digits"]),
        ("name=x", ["study=NAME"]),
        ("name=x,y", ["study=NAME"]),
        ("seed=1,2", ["sweep.seeds"]),
        ("tracking.uri=a,b", ["cannot be searched"]),
        ("sweep.train=['seed=1,2']", ["sweep.train: seed=1,2", "sweep.space"]),
        ("network=glob(x*)", ["matches no network", "mlp_small"]),
        ("netwrk=glob(*)", ["did you mean network?"]),
        ("algorithm.lr=interval(1,", ["GROUP=OPTION or KEY=VALUE"]),
    ],
)
def test_what_cannot_be_used_is_named_with_what_would_do(override, parts):
    message = refusal(override)
    for part in parts:
        assert part in message


def test_a_value_of_a_ready_made_space_must_be_searched(own):
    own("sweep/mine.yaml", "defaults: [own, _self_]\nspace: {algorithm.lr: '0.1'}\n")
    assert "nothing to search" in refusal("sweep=mine")
    own("sweep/mine.yaml", "defaults: [own, _self_]\nspace: {algorithm.lr: '0.1,0.2'}\n")
    assert compose_sweep(["sweep=mine"]).space == {"algorithm.lr": "0.1,0.2"}


# --- Dimensions


@pytest.mark.parametrize(
    ("expression", "found"),
    [
        ("interval(0, 0.05)", Range(0.0, 0.05, None, False)),
        ("interval(1, 10)", Range(1.0, 10.0, None, False)),
        ("int(interval(1, 10))", Range(1, 10, 1, False)),
        ("tag(log, interval(1e-5, 1e-3))", Range(1e-5, 1e-3, None, True)),
        ("tag(log, int(interval(1, 1000)))", Range(1, 1000, 1, True)),
        ("range(5)", Range(0, 4, 1, False)),
        ("range(5, 12, 2)", Range(5, 11, 2, False)),
        ("range(10, 0, -3)", Range(1, 10, 3, False)),
        ("range(0.1, 0.5, 0.1)", Range(0.1, 0.4, 0.1, False)),
        ("range(0, 1, 0.3)", Range(0.0, 0.9, 0.3, False)),
        ("range(0, 1e15, 0.1)", Range(0.0, 999999999999999.9, 0.1, False)),  # at once, not value by value
        ("7,2.5,true,null,mlp", Choices((7, 2.5, True, None, "mlp"))),
        ("choice('1', [1,2], {a:1})", Choices(("'1'", "[1,2]", "{a:1}"))),
        ("shuffle(3,1,2)", Choices((3, 1, 2))),
    ],
)
def test_an_expression_is_choices_or_a_range(expression, found):
    assert dimension("seed", expression) == found
    assert repr(dimension("seed", expression)) == repr(found)  # 1 and 1.0 are not the same


def test_a_range_is_all_its_values():
    assert Range(0.1, 0.4, 0.1, False).values() == [0.1, 0.2, 0.3, 0.4]
    assert Range(1, 10, 3, False).values() == [1, 4, 7, 10]
    assert Range(0.1, 0.4, None, False).values() is None


@pytest.mark.parametrize(
    ("expression", "part"),
    [
        ("interval(5, 1)", "LOW < HIGH"),
        ("interval(1, 1)", "LOW < HIGH"),
        ("interval(0, inf)", "finite"),
        ("range(0, inf, 0.1)", "finite"),
        ("range(3, 1)", "has no values"),
        ("range(3, 2.5)", "has no values"),
        ("range(1, 5, 0)", "has no values"),
        ("tag(log, interval(0, 1))", "above 0"),
        ("tag(log, range(1, 100, 2))", "no steps"),
        ("tag(lin, interval(0, 1))", "accepted: log"),
        ("tag(log, choice(1, 2))", "accepted: log"),
        ("1,2,1", "twice"),
        ("0.1", "nothing to search"),
        ("[1,2]", "nothing to search"),
    ],
)
def test_a_search_of_nothing_is_refused(expression, part):
    message = refused(dimension, "algorithm.lr", expression)
    assert message.startswith("algorithm.lr=")
    assert part in message


@given(st.floats(allow_nan=False, allow_infinity=False) | st.integers() | st.booleans() | st.none())
def test_a_value_is_written_to_its_last_digit(value):
    read = override_value(as_override("algorithm.lr", value))
    assert (type(read), read) == (type(value), value)


@pytest.mark.parametrize(
    "expression",
    ["'a b',\"c,d\",plain", "[1,'x y'],[2]", "null,'null',1,'1'", "choice('null','1','x y',[1,'2'])"],
)
def test_a_choice_is_written_as_it_is_read(expression):
    what = dimension("track.title", expression)
    assert isinstance(what, Choices)
    lines = [as_override("track.title", value) for value in what.values]
    assert len({repr(parse_single(line).value()) for line in lines}) == len(what.values)


def test_paths_are_searched_as_they_are_typed():
    what = dimension("reward.file", "mein Lohn.py,größer (2).py")
    assert isinstance(what, Choices)
    lines = [as_override("reward.file", value) for value in what.values]
    assert [override_value(line) for line in lines] == ["mein Lohn.py", "größer (2).py"]


def test_another_clone_takes_the_place_of_the_whole_one_before():
    season = ("sweep=season", "track=Oval_track")
    for words, found in (
        (("sweep.clone={algorithm.lr: 1e-5}",), {"algorithm.lr": 1e-5}),
        (("sweep.clone={seed: 3, budget.iterations: 2}", "sweep.clone={seed: 4}"), {"seed": 4}),
        (("sweep.clone=null",), None),
    ):
        assert compose_sweep([*season, *words]).entry.sweep.clone == found
