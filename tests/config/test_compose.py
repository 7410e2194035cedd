import dataclasses
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.config.compose import compose_experiment, compose_option, expand_grid
from deepracer_exp.config.driving import RandomizationConfig
from deepracer_exp.config.options import options_of
from deepracer_exp.config.overrides import parse_single
from deepracer_exp.config.parse import parse_experiment
from deepracer_exp.config.stored import with_overrides
from deepracer_exp.errors import BadInput
from tests.conftest import refused


def refusal(*overrides: str) -> str:
    return refused(compose_experiment, overrides)


# --- What is accepted


def test_the_default_experiment_composes():
    experiment, composition = compose_experiment([])
    assert experiment.track.name == composition.choices["track"] == "reinvent_base"
    assert "experiment" not in composition.choices


def test_the_last_of_two_overrides_counts():
    assert compose_experiment(["seed=1", "seed=2"])[0].seed == 2


def test_values_override_a_chosen_experiment():
    experiment, composition = compose_experiment(["experiment=tiny", "budget.env_steps=77"])
    assert (experiment.name, experiment.budget.env_steps, composition.choices["experiment"]) == (
        "tiny",
        77,
        "tiny",
    )


def test_what_an_experiment_keeps_of_a_chosen_option_is_said():
    experiment, composition = compose_experiment(["experiment=sliding_car", "network=mlp_small"])
    (note,) = (note for note in composition.notes if "stays beside" in note)
    hidden = list(experiment.network.hidden)
    assert hidden != list(compose_experiment(["network=mlp_small"])[0].network.hidden)
    assert note.startswith("experiment=sliding_car: ")
    assert f"network.hidden={hidden}".replace(" ", "") in note.replace(" ", "")
    assert note.endswith("stays beside network=mlp_small")
    assert compose_experiment(["experiment=sliding_car"])[1].notes == ()
    assert compose_experiment(["experiment=tiny", "track=Oval_track"])[1].notes == ()


def test_what_an_experiment_says_of_its_track_holds_on_each_of_several(own_experiment):
    own_experiment(
        "defaults: [{override /track: Oval_track}]\ntrack: {floor: {friction: 0.7}, direction: alternate}\n"
    )
    tracks = compose_experiment(["experiment=wet", "track=[reinvent_base,AWS_track]"])[0].tracks
    assert [*tracks] == ["reinvent_base", "AWS_track"]
    assert {(track.floor.friction, track.direction) for track in tracks.values()} == {(0.7, "alternate")}


def test_an_experiment_without_its_first_line_is_named(own_experiment):
    own_experiment("seed: 3\n", first_line="")
    with pytest.raises(BadInput, match=r"wet\.yaml.*lacks its first line, # @package _global_"):
        compose_experiment(["experiment=wet"])


@pytest.fixture
def own_experiment(here):
    """Write an experiment of one's own, `wet`."""

    def write(text: str, first_line: str = "# @package _global_\n") -> None:
        folder = here / "conf" / "experiment"
        folder.mkdir(parents=True)
        (folder / "wet.yaml").write_text(first_line + text)

    return write


@pytest.mark.parametrize("prefix", ["", "+", "++"])
def test_a_constant_of_the_reward_needs_no_plus(prefix):
    experiment, _ = compose_experiment([f"{prefix}reward.constants.PROGRESS_WEIGHT=2.5"])
    assert experiment.reward.constants == {"PROGRESS_WEIGHT": 2.5}


def test_an_option_may_be_named_as_its_file():
    assert compose_experiment(["track=Oval_track.yaml"])[1].choices["track"] == "Oval_track"


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["experiment=fast_lap", "track=reinvent_wood"],
        ["track.file=/tmp/ein Weg, (schön) = gut/ü's.npy", "algorithm.lr=1e-5", "reward.constants.A=-3"],
        ["budget.minutes=1e3", "runs_dir='2024'", "track.title='yes: no'"],
    ],
)
def test_what_is_printed_can_be_read_back(overrides):
    experiment, composition = compose_experiment(overrides)
    assert parse_experiment(yaml.safe_load(composition.yaml())) == experiment


# --- Paths and addresses are typed as they are


@pytest.mark.parametrize(
    "text", ["a b,ü/c=d (alt).npy", r"C:\cars\new\it's.py", "http://localhost:5000/?a=b&c={d}#e", "2024"]
)
def test_a_path_or_address_needs_no_quotes(text):
    for key in ("track.file", "reward.file", "action_space.file", "runs_dir", "tracking.uri"):
        assert parse_single(f"{key}={text}").value() == text
    assert compose_experiment([f"reward.file={text}"])[0].reward.file == text


@given(
    text=st.text(
        st.characters(exclude_categories=["Cs", "Cc"], exclude_characters="$\u2028\u2029"), min_size=1
    ).filter(lambda text: text[0] not in "'\"~" and text.lower() != "null")
)
def test_any_text_is_taken_as_a_path(text):
    assert parse_single(f"reward.file={text}").value() == text


def test_quotes_home_and_environment_variables_are_understood(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("RACES", "/data/ä b")
    overrides = ["track.file=~/a.npy", "runs_dir=${oc.env:RACES}/x", "reward.file='a b,(1)=ä.py'"]
    experiment, _ = compose_experiment([*overrides, "action_space.file=a.json", "action_space.file=null"])
    assert experiment.track.file == str(tmp_path / "a.npy")
    assert experiment.runs_dir == "/data/ä b/x"
    assert (experiment.reward.file, experiment.action_space.file) == ("a b,(1)=ä.py", None)


# --- What is refused


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("track=Ovaltrack", ["track=Ovaltrack", "did you mean Oval_track?"]),
        ("experiment=tyni", ["experiment=tyni", "did you mean tiny?"]),
        ("network=3", ["network=3: no such network", "mlp_small"]),
        ("reward=[racing_line,follow_center_line]", ["several options; accepted: one; -m reward=A,B"]),
        ("track={a:1}", ["no such track", "`deepracer-exp train --options track` lists them"]),
        ("device=gpu", ['device="gpu"', "accepted: cpu, cuda"]),
        ("sed=1", ["sed: no such key (did you mean seed?)"]),
        ("algoritm=ppo", ["did you mean algorithm?"]),
        ("lr=1", ["did you mean algorithm.lr?"]),
        ("algorithm.epoch=1", ["did you mean epochs?"]),
        ("algorithm.learning_rate=1", ["with algorithm=ppo", "known: lr, batch_size"]),
        (
            "lr_schedule.lengths=3",
            ["lr_schedule.lengths: no such key with lr_schedule=linear", "known: kind, by, warmup"],
        ),
        ("+foo=1", ["foo: no such key"]),
        ("+algorithm.foo=1", ["algorithm.foo: no such key", "known: lr"]),
        ("+track.floor.x=1", ["track.floor.x: no such key", "friction"]),
        ("++car.weight_kg=1", ["car.weight_kg: no such key"]),
        ("track@other=Oval_track", ["write track=OPTION"]),
        ("hydra.run.dir=x", ["hydra.run.dir", "runs_dir"]),
        ("hydra/launcher=basic", ["hydra/launcher"]),
        ("~track", ["track: missing"]),
        ("~reward.constants.X", ["reward.constants.X"]),
        ("stopping.kind=x", ["stopping.kind=x: no such kind; accepted: 'none', 'reliable'"]),
        ("lr_schedule.kind=x", ["lr_schedule.kind=x: no such kind; accepted: 'constant', 'linear'"]),
        ("tracking.kind=x", ["tracking.kind=x: no such kind; accepted: 'off', 'mlflow'"]),
    ],
)
def test_an_unknown_name_is_answered_with_the_nearest_known_one(override, parts):
    message = refusal(override)
    for part in parts:
        assert part in message


def test_an_unknown_key_is_looked_for_in_the_chosen_option():
    assert "with tracking=off; known: kind" in refusal("tracking=off", "tracking.uri=x")
    assert "did you mean length?" in refusal("lr_schedule=step", "lr_schedule.lenght=2")


@pytest.mark.parametrize(
    ("override", "accepted"),
    [
        ("seed=a", "valid integer"),
        ("seed=1.5", "integer"),
        ("seed=true", "valid integer"),
        ("seed=-1", "greater than or equal to 0"),
        ("seed=2147483648", "less than 2147483648"),
        ("algorithm.lr='3'", "valid number"),
        ("algorithm.lr=true", "valid number"),
        ("algorithm.lr=0", "greater than 0"),
        ("algorithm.lr=nan", "finite"),
        ("algorithm.lr=inf", "finite"),
        ("algorithm.discount=1.1", "less than or equal to 1"),
        ("algorithm.batch_size=0", "greater than or equal to 1"),
        ("debug=yes", "valid boolean"),
        ("debug=1", "valid boolean"),
        ("name=a/b", "letters, digits"),
        ("name=..", "letters, digits"),
        ("runs_dir=", "at least 1 character"),
        ("collector.processes=0", "greater than or equal to 1"),
        ("track.direction=backwards", "'forward', 'reversed' or 'alternate'"),
        ("track.floor.road_color=red", "pattern"),
        ("car.steering_kick=1", "less than 1"),
        ("episode.start_offset=1", "less than 1"),
        ("reward.constants.X=abc", "valid number"),
        ("observation.lookahead_m=[1,-2]", "greater than 0"),
        ("action_space.steering_angle.high=99", "less than or equal to 60"),
    ],
)
def test_a_value_of_the_wrong_kind_is_named_with_what_would_do(override, accepted):
    message = refusal(override)
    assert message.startswith(override.split("=")[0])
    assert accepted in message


@pytest.mark.parametrize(
    ("overrides", "both"),
    [
        (["algorithm.batch_size=9999", "algorithm.frames_per_iteration=4096"], ["9999", "4096"]),
        (
            ["algorithm.frames_per_iteration=300", "algorithm.batch_size=1", "collector.cars=301"],
            ["300", "301"],
        ),
        (["algorithm.episodes_per_iteration=3"], ["frames_per_iteration=", "episodes_per_iteration=3"]),
        (
            ["algorithm.frames_per_iteration=null"],
            ["frames_per_iteration=None", "episodes_per_iteration=None"],
        ),
        (["collector=in_process", "collector.processes=3"], ["processes=3", "in_process"]),
        (["collector.processes=3"], ["processes=3", "cars=256", "accepted: 1, 2, 4"]),
        (["collector.cars=12", "collector.processes=4"], ["processes=4", "cars=12", "at least 4", "1, 2, 3"]),
        (["track.width_m=[1,2]", "track.knots=[[0,0],[1,0],[1,1]]"], ["2 values", "knots 3"]),
        (["track.width_m=0.8"], ["track.width_m without track.knots"]),
        (["track.name=moon"], ["track.name=moon: not a world"]),
        (["car.min_speed_mps=5"], ["5.0", "4.0"]),
        (["car.rear_axle_x_m=1"], ["1.0", "0.082311"]),
        (["reward.time_limit_s=30"], ["30", "20"]),
        (["observation=camera", "network.kernels=[1]"], ["network: filters, kernels and strides"]),
        (["budget.env_steps=null"], ["env_steps", "iterations", "minutes"]),
    ],
)
def test_values_that_contradict_each_other_are_both_named(overrides, both):
    message = refusal(*overrides)
    for part in both:
        assert part in message


@pytest.mark.parametrize("override", ["seed", "", "=3", "seed=1=2", "--multirun", "name=ü"])
def test_what_is_no_override_is_answered_with_how_to_write_one(override):
    assert "GROUP=OPTION or KEY=VALUE" in refusal(override)


def test_quotes_are_suggested_where_they_are_needed():
    assert "\"track.title='Nürburg'\"" in refusal("track.title=Nürburg")
    assert compose_experiment(["track.title='Nürburg'"])[0].track.title == "Nürburg"


@pytest.mark.parametrize(
    "override", ["seed=1,2", "network=mlp,mlp_small", "seed=range(3)", "seed=choice(1,2)"]
)
def test_several_values_without_m_are_answered_with_m(override):
    message = refusal(override)
    assert message.startswith(override)
    assert "-m" in message


def test_an_unknown_group_is_answered_with_the_groups():
    with pytest.raises(BadInput, match=r"did you mean track\?.*network"):
        options_of("trak")
    assert "Monaco" in options_of("track")


# --- Grids


def test_a_grid_is_every_combination_the_last_key_fastest():
    assert expand_grid(["seed=1,2", "experiment=tiny", "network=mlp,mlp_small"]) == [
        ["seed=1", "experiment=tiny", "network=mlp"],
        ["seed=1", "experiment=tiny", "network=mlp_small"],
        ["seed=2", "experiment=tiny", "network=mlp"],
        ["seed=2", "experiment=tiny", "network=mlp_small"],
    ]


def test_ranges_and_choices_are_lists():
    assert expand_grid(["seed=range(1,4)"]) == [["seed=1"], ["seed=2"], ["seed=3"]]
    assert expand_grid(["seed=choice(5,7)"]) == [["seed=5"], ["seed=7"]]
    assert expand_grid(["seed=3"]) == [["seed=3"]]
    assert expand_grid([]) == [[]]
    assert len(expand_grid(["seed=range(1000)"])) == 1000
    for many in (["seed=range(1001)"], [f"seed={','.join(map(str, range(40)))}", "name=range(40)"]):
        with pytest.raises(BadInput, match="more than 1,000 runs"):
            expand_grid(many)


@pytest.mark.parametrize(
    ("override", "files"),
    [
        ("reward.file=a.py,b.py", ["a.py", "b.py"]),
        ("reward.file=mein Lohn.py,größer (2).py", ["mein Lohn.py", "größer (2).py"]),
        ("reward.file='a,b.py',c.py", ["a,b.py", "c.py"]),
        ("reward.file=null,a.py", [None, "a.py"]),
        ("reward.file=nur ä.py", ["nur ä.py"]),
    ],
)
def test_a_grid_of_paths_gives_each_path(override, files):
    runs = expand_grid([override])
    assert [compose_experiment(run)[0].reward.file for run in runs] == files


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("algorithm.lr=interval(0,1)", "lists and ranges"),
        ("track=glob(re*)", "lists and ranges"),
        ("seed", "GROUP=OPTION or KEY=VALUE"),
    ],
)
def test_a_malformed_grid_is_refused(override, says):
    with pytest.raises(BadInput, match=says):
        expand_grid(["name=a,b", override])


def test_the_configuration_stays_usable_after_a_refusal(tmp_path, monkeypatch):
    refusal("track=Nowhere")
    monkeypatch.chdir(tmp_path)
    assert compose_experiment(["track=Monaco"])[0].track.name == "Monaco"
    assert list(Path(tmp_path).iterdir()) == []


# --- An option by itself


def test_an_option_by_itself_may_be_ones_own(own):
    own("randomization/wet.yaml", "defaults: [sim2real, _self_]\nfriction_scale: [0.3, 0.4]\n")
    wet, usual = (compose_option("randomization", name, RandomizationConfig) for name in ("wet", "sim2real"))
    assert wet == dataclasses.replace(usual, friction_scale=(0.3, 0.4))
    assert usual == compose_experiment(["randomization=sim2real"])[0].randomization


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("friction_scale: [0.3, wet]", ["randomization=mine", "friction_scale", "wet"]),
        ("friction: [0.3, 0.4]", ["randomization=mine", "friction", "no such key"]),
        ("friction_scale: ${car.nothing}", ["randomization=mine", "car.nothing"]),
        ("x: [1", ["conf/randomization/mine.yaml"]),
        ("a: &a [*a]", ["conf/randomization/mine.yaml"]),
    ],
)
def test_an_option_by_itself_is_refused_with_its_name(text, words, own):
    own("randomization/mine.yaml", f"defaults: [none, _self_]\n{text}\n")
    message = refused(compose_option, "randomization", "mine", RandomizationConfig)
    for word in words:
        assert word in message


def test_an_option_by_itself_that_is_not_there_is_refused_with_the_nearest():
    with pytest.raises(BadInput, match=r"randomization=sim2rael: no such .*did you mean sim2real"):
        compose_option("randomization", "sim2rael", RandomizationConfig)


def test_a_password_in_a_change_of_a_stored_run_is_not_kept():
    stored = compose_experiment([])[1].mapping
    changed = with_overrides(stored, {}, ["tracking.uri=http://me:s3cret@127.0.0.1:5000"])
    assert "s3cret" not in changed.yaml()
    assert "s3cret" not in " ".join(changed.overrides)
