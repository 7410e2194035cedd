import pytest
from hypothesis import given
from hypothesis import strategies as st
from mlflow.utils.validation import _validate_metric_name

from deepracer_exp.config.options import options
from deepracer_exp.tracking.names import TRACK_METRICS, joined, track_labels, track_metric

awkward = st.text(st.sampled_from("aAb_-.2/ :ß"), max_size=6)


@given(st.lists(awkward | st.text(max_size=300), max_size=12))
def test_every_track_has_a_metric_name_that_mlflow_takes_and_no_other_track_has(names):
    labels = track_labels(names)
    assert len({label.casefold() for label in labels}) == len(labels) == len(names)
    for label in labels:
        for metric in TRACK_METRICS:
            name = track_metric(metric, label)
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
