"""`deepracer-exp analyze` and `watch` of a physical car's drive, alone and beside a policy of ours."""

import io
import shutil

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict

from deepracer_exp.analysis.car_drive import action_names, in_order, spells
from deepracer_exp.aws.logs.car_log import read_car_log
from deepracer_exp.env.action_space import build_action_space, metadata_of
from deepracer_exp.lookup.resolve import StoredRun
from deepracer_exp.reports.car_drive import grey_pictures
from tests.aws.made_up_bags import drive_outputs, jpeg, write_bag
from tests.export.test_car_check import TINY
from tests.page_html import Html

pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A drive of 60 pictures, of which 20 to 34 are doubtful."""
    return write_bag(tmp_path_factory.mktemp("bags") / "season-1", drive_outputs(60, slice(20, 35)))


def test_a_drive_is_analysed_into_a_page_and_the_terminal(bag, call):
    ended = call("analyze", str(bag))
    assert ended.code == 0, ended.stderr
    assert "season-1: 60 pictures in 2.0 s, 30.0 a second" in ended.stdout
    assert "hesitates on 25% of the pictures" in ended.stdout
    assert "the longest from 0.7 to 1.1 s" in ended.stdout
    # 20 ms were logged, 34 ms of camera and servo are in no log.
    assert "timing.frames_per_s=30 evaluation.real_car.timing.latency_s=0.054" in ended.stdout
    page = (ended.cwd / "season-1-analysis.html").read_text(encoding="utf-8")
    text = Html(page).text
    printed = [line[5:] for line in ended.stdout.splitlines() if line[2:3].isdigit() and line[3:5] == "  "]
    assert len(printed) >= 4
    assert all(" ".join(line.split()) in text for line in printed)
    for figure in ("drive_probabilities", "drive_commands", "drive_pace"):
        assert f'id="figure-{figure}"' in page


def test_hesitation_is_found_where_two_actions_are_nearly_as_likely_and_nowhere_else(bag, tmp_path):
    log = read_car_log(bag)
    (spell,) = spells(log)
    assert (spell.first, spell.last) == (20, 34)
    assert not spells(read_car_log(write_bag(tmp_path / "sure", drive_outputs(30))))


def test_actions_are_shown_from_left_to_right_and_those_never_taken_last(bag):
    log = read_car_log(bag)
    assert in_order(log).tolist() == [0, 1, 3, 4, 2]
    assert action_names(log)[1:3] == ["1: left 50%", "2"]


def test_the_policy_that_drove_would_have_done_the_same_on_every_picture(trained, call, tmp_path):
    run = StoredRun(trained(*TINY).folder).with_policy()
    policy, actions = run.read_policy().networks.policy, build_action_space(run.experiment.action_space)
    pictures = [jpeg(row) for row in range(12)]
    grey = np.stack([np.asarray(Image.open(io.BytesIO(picture)).convert("L")) for picture in pictures])
    with torch.no_grad():
        outputs = policy(TensorDict({"pixels": torch.from_numpy(grey[:, None])}, [12]))["logits"].softmax(-1)
    steering = np.array(metadata_of(actions).actions)[outputs.argmax(-1).numpy(), 0]
    bag = write_bag(tmp_path / "own", outputs.numpy(), steering=steering / np.abs(actions.steering_deg).max())
    ended = call("analyze", str(bag), str(run.path))
    assert ended.code == 0, ended.stderr
    assert "tiny would have taken the same action on 100.0% of the pictures" in ended.stdout
    assert "otherwise on 0.0% of the pictures" in ended.stdout
    page = (ended.cwd / "own-analysis.html").read_text(encoding="utf-8")
    assert "where it looks" in page


def test_a_drive_is_filmed_as_long_as_it_took(tmp_path, call):
    bag = write_bag(tmp_path / "short", drive_outputs(15))
    ended = call("watch", str(bag), "-o", "drive.mp4")
    assert ended.code == 0, ended.stderr
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(ended.cwd / "drive.mp4"))
    assert frames == 15 + 30  # the last one is shown for a second
    assert seconds == pytest.approx(1.5, abs=0.1)


def test_large_frames_are_made_smaller_as_the_car_does(tmp_path):
    bag = write_bag(
        tmp_path / "large", drive_outputs(2), pictures=[jpeg(row, (640, 480)) for row in range(2)]
    )
    large, small = (
        grey_pictures(read_car_log(place), 1)
        for place in (bag, write_bag(tmp_path / "small", drive_outputs(2)))
    )
    assert large.shape == small.shape == (1, 120, 160)
    assert np.abs(large.astype(int) - small).mean() < 3


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("analyze", "{bag}", "--replay", "laps.html"), "--replay"),
        (("analyze", "{bag}", "--target", "9"), "--target"),
        (("analyze", "{bag}", "checkpoint=last"), "of which run?"),
        (("analyze", "{bag}", "missing"), "no such run"),
        (("analyze", "{bag}", "a", "b"), "3 given"),
        (("compare", "{bag}", "{bag}"), "by deepracer-exp analyze and watch"),
        (("watch", "{bag}", "--live"), "--live"),
        (("watch", "{bag}", "-o", "film.avi"), ".mp4"),
    ],
)
def test_what_a_drive_has_not_is_refused(bag, call, words, line):
    call(*(word.format(bag=bag) for word in words)).assert_refused(line)


def test_a_policy_of_features_cannot_decide_on_pictures(bag, trained, call):
    call("analyze", str(bag), str(trained().folder)).assert_refused("the car has no features")


def test_damaged_pictures_and_damaged_bags_are_refused_in_one_line(bag, call, tmp_path):
    broken = write_bag(tmp_path / "broken", drive_outputs(3), pictures=[b"\xff\xd8 no picture"] * 3)
    call("analyze", str(broken)).assert_refused("broken: picture 0", "JPEG")
    small = write_bag(
        tmp_path / "small", drive_outputs(2), pictures=[jpeg(row, (80, 60)) for row in range(2)]
    )
    call("watch", str(small)).assert_refused("is 80x60")
    cut = shutil.copytree(bag, tmp_path / "cut")
    (file,) = cut.glob("*.db3")
    file.write_bytes(file.read_bytes()[:3000])
    for command in ("analyze", "watch"):
        call(command, str(cut)).assert_refused(f"{cut}: damaged")
