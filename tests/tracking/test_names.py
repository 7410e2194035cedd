import os
from dataclasses import fields

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mlflow.utils.validation import _validate_metric_name

from deepracer_exp.agents.sac import SACMetrics
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.options import options
from deepracer_exp.evaluation.results import EVAL_COLUMNS
from deepracer_exp.tracking.metadata import (
    LONGEST_PARAM,
    flatten,
    joined,
    param_text,
    run_params,
    run_tags,
    user_tags,
)
from deepracer_exp.tracking.mlflow_metrics import (
    BEST,
    METRICS,
    TRACK_METRICS,
    metric_name,
    track_labels,
)

awkward = st.text(st.sampled_from("aAb_-.2/ :ß"), max_size=6)


@given(st.lists(awkward | st.text(max_size=300), max_size=12))
def test_every_track_has_a_metric_name_that_mlflow_takes_and_no_other_track_has(names):
    labels = track_labels(names)
    assert len({label.casefold() for label in labels}) == len(labels) == len(names)
    for label in labels:
        for metric in TRACK_METRICS:
            name = f"{metric}/{label}"
            _validate_metric_name(name)
            assert len(name) <= 250
            assert name.split("/") == [metric, label]


def test_the_tracks_of_the_catalogue_keep_their_names():
    assert track_labels(options("track")) == options("track")


@pytest.mark.parametrize(
    ("names", "label"),
    [
        (["Oval_track"], "Oval_track"),
        (["a", "b"], "a+b"),
        (["a", "b", "c"], "a+b+c"),
        (["a", "b", "c", "d"], "4 tracks"),
        (["a" * 90, "b" * 90], "2 tracks"),
        (["a" * 200], "a" * 200),
    ],
)
def test_up_to_three_tracks_are_named_and_more_are_counted(names, label):
    assert joined(names) == label


def test_every_column_has_a_name_of_its_own_in_a_section_and_race_is_the_first():
    columns = [*EVAL_COLUMNS, *(field.name for field in fields(SACMetrics)), *TRACK_METRICS]
    assert set(columns) <= set(METRICS)
    names = [metric_name(column) for column in METRICS]
    assert len(set(names)) == len(names)
    # MLflow's pages sort sections by their names; without a slash a metric stands in none.
    sections = sorted({name.rpartition("/")[0] for name in [*names, f"{BEST}x"]})
    assert sections == ["race", "race/best", "system", "time", "train", "update"]
    assert metric_name("lap_share/Oval_track") == "train/lap_share/Oval_track"
    assert metric_name("of_tomorrow") == "train/of_tomorrow"


@pytest.mark.parametrize(
    ("overrides", "more"),
    [
        ([], {}),
        (["car.tyre_friction=0.5", "seed=7"], {"car.tyre_friction": "0.5", "seed": "7"}),
        (["network=mlp", "reward.constants.X=2"], {"network": "mlp", "reward.constants.X": "2"}),
    ],
)
def test_parameters_are_what_was_chosen_and_what_racers_vary(overrides, more):
    _, composition = compose_experiment(overrides)
    params = run_params(
        composition.choices, {"track": "my track"}, composition.mapping, composition.overrides
    )
    assert len(params) < 50
    assert {"algorithm.lr", "network.hidden", "seed", "car", "stopping", "reward"} <= params.keys()
    assert params["track"] == "my track"
    assert params.items() >= more.items()
    own = {"car.tyre_friction"} & more.keys()
    assert {key for key in params if key.startswith(("car.", "track.", "episode.", "evaluation."))} == own


def test_every_leaf_is_found_under_its_dotted_key_as_yaml_writes_it():
    config = {"a": {"b": {"c": None, "d": True}, "e": [1, {"f": "ß"}], "g": {}}, "h": 3e-4, "i": "mlp"}
    assert {key: param_text(value) for key, value in flatten(config).items()} == {
        **{"a.b.c": "null", "a.b.d": "true", "a.e": '[1,{"f":"ß"}]', "a.g": "{}"},
        **{"h": "0.0003", "i": "mlp"},
    }


@given(st.text(min_size=LONGEST_PARAM + 1, max_size=LONGEST_PARAM + 50), st.text(max_size=5))
def test_long_values_are_cut_but_stay_distinguishable(text, end):
    cut = param_text(text)
    assert len(cut) == LONGEST_PARAM
    assert (param_text(text + end) == cut) == (end == "")


@pytest.mark.parametrize("name", ["anna", None])
def test_every_run_says_who_made_it_and_where(monkeypatch, tmp_path, name):
    def no_name() -> str:
        raise KeyError("uid not found")

    monkeypatch.setattr("getpass.getuser", no_name if name is None else lambda: name)
    monkeypatch.setattr("socket.gethostname", lambda: "box")
    wanted = {"mlflow.user": name or f"uid {os.getuid()}", "host": "box"}
    assert run_tags({}, None, "0", tmp_path).items() >= wanted.items()
    assert user_tags() == wanted
