import dataclasses
import re

import pytest
import yaml

from deepracer_exp.config.compose import compose_evaluation
from deepracer_exp.config.evaluation import EvaluateConfig
from deepracer_exp.config.options import conf_dir, groups


def test_every_key_of_the_entry_point_is_explained():
    lines = (conf_dir() / "evaluate.yaml").read_text().splitlines()
    for above, line in zip(["", *lines], lines, strict=False):
        if re.match(r"(?!defaults)\w+:", line):
            assert above.startswith("#"), f"{line} has no comment above it"


def test_the_entry_point_is_its_group_and_a_few_keys():
    assert groups("evaluate") == ["evaluation"]
    entry = yaml.safe_load((conf_dir() / "evaluate.yaml").read_text())
    assert set(entry) - {"defaults"} == {f.name for f in dataclasses.fields(EvaluateConfig)} - {"evaluation"}


def test_a_checkpoint_may_look_like_a_number():
    assert compose_evaluation(["checkpoint=000012"])[0].checkpoint == "000012"


@pytest.mark.parametrize(
    ("given", "tracks"),
    [
        ("Oval_track", "Oval_track"),
        ("all", "all"),
        ("[Oval_track,AWS_track]", ("Oval_track", "AWS_track")),
    ],
)
def test_tracks_are_one_or_several_or_all(given, tracks):
    config, _ = compose_evaluation([f"evaluation.tracks={given}"])
    assert config.evaluation.tracks == tracks
