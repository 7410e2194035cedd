"""The check before a drive with the physical car."""

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict

from deepracer_exp.analysis.zigzag import ZigZag
from deepracer_exp.config.driving import CameraConfig
from deepracer_exp.env.action_space import DiscreteActions
from deepracer_exp.evaluation.evaluate import CAR, SIMULATOR
from deepracer_exp.evaluation.race_protocol import Attempt
from deepracer_exp.evaluation.result import USUAL, Evaluation, TrialGroup
from deepracer_exp.export.car_check import CarCheck, CarLaps
from deepracer_exp.reports.picture_changes import CHANGES, pictures_sheet, spread_out, try_pictures

CAMERA = CameraConfig(width=160, height=120, color="grey", frames=1, stereo_m=0.0, field_of_view_deg=65.0)
ACTIONS = DiscreteActions(np.array([-20.0, 20.0]), np.array([1.0, 2.0]))
STEADY = ZigZag(straight_m=20.0, laps=1.0)
SWERVING = ZigZag(straight_m=20.0, laps=1.0, changes=40, swings_deg=800.0, detour_s=1.0)
TINY = (
    *("observation=camera", "action_space=grid", "collector.cars=4", "algorithm.frames_per_iteration=64"),
    *("algorithm.batch_size=32", "algorithm.epochs=1", "budget.env_steps=64", "checkpoints.every=null"),
)


class Threshold(torch.nn.Module):
    """Steers to the left where the picture is brighter than a value, else to the right."""

    def __init__(self, least):
        super().__init__()
        self.least = least

    def forward(self, seen):
        left = (seen["pixels"].float().mean((1, 2, 3)) > self.least).long()
        logits = torch.nn.functional.one_hot(left, 2).float() * 10
        return seen.set("logits", logits).set("action", left)


def seen(policy, *values):
    pixels = torch.stack([torch.full((1, 120, 160), value, dtype=torch.uint8) for value in values])
    return policy(TensorDict({"pixels": pixels}, [len(values)]))


def laps(share, zigzag=STEADY):
    ends = ["lap_complete" if trial < 20 * share else "off_track" for trial in range(20)]
    attempts = tuple(
        Attempt(
            trial=trial,
            begin_s=0.0,
            time_s=9.0,
            penalty_s=0.0,
            resets=0,
            progress=100.0 if end == "lap_complete" else 40.0,
            end=end,
        )
        for trial, end in enumerate(ends)
    )
    group = TrialGroup("a", USUAL, tuple(range(20)), attempts, (zigzag,) * 20)
    return CarLaps(Evaluation((group,)), 0.1)


def check(pictures=(200,), network_s=0.001, zigzag=STEADY, **shares):
    policy = Threshold(100)
    driven = {name: laps(shares.get(name, 1.0), zigzag) for name in (SIMULATOR, "picture", "controls", CAR)}
    return CarCheck(driven, network_s, 1 / 30, try_pictures(policy, seen(policy, *pictures), ACTIONS))


def test_a_policy_that_loses_nothing_is_ready():
    assert check().to_do() == []


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ({"network_s": 0.02}, "network=cnn_small"),
        ({SIMULATOR: 0.9}, "train further"),
        ({"picture": 0.85}, "picture: 85% of the laps are complete, wanted 90%"),
        (
            {"controls": 0.5},
            "controls: 50% of the laps are complete, wanted 90%; train with randomization=real_car",
        ),
        ({CAR: 0.8}, "all parts together"),
        ({"zigzag": SWERVING}, "zig-zags"),
        ({"pictures": (200, 110)}, "50% of the pictures decide badly"),
    ],
)
def test_each_fault_alone_makes_it_not_ready_and_says_what_to_do(found, words):
    (step,) = check(**found).to_do()
    assert words in step


def test_what_fails_in_the_simulator_is_not_blamed_on_the_car():
    steps = check(**{SIMULATOR: 0.5, "picture": 0.4, "controls": 0.4, CAR: 0.3}).to_do()
    assert len(steps) == 1
    assert "in the simulator" in steps[0]


def test_only_pictures_in_which_a_small_change_turns_the_wheels_decide_badly():
    policy = Threshold(100)
    tried = try_pictures(policy, seen(policy, 200, 110, 40, 90), ACTIONS)
    assert sorted(tried.bad) == [1, 3]  # 110 * 0.8 and 90 * 1.25 lie on the other side of 100
    assert tried.words() == "2 of 4 (50%): darker 1, brighter 1"
    sheet = pictures_sheet(tried, policy, CAMERA)
    assert sheet.width == 4 * 320
    assert 240 < sheet.height < 320


def test_a_sheet_shows_no_neighbours():
    rows = np.array([50, 51, 49, 10, 58, 57, 100])
    assert spread_out(rows, np.arange(200), 8, 8) == [50, 10, 58, 100]
    assert spread_out(rows, np.arange(200), 8, 2) == [50, 10]


def test_changes_keep_size_and_kind_of_pictures_and_move_rows_the_way_they_say():
    pixels = np.arange(120, dtype=np.uint8)[None, None, :, None].repeat(160, axis=3)
    for change in CHANGES.values():
        changed = change(pixels)
        assert (changed.shape, changed.dtype) == (pixels.shape, np.uint8)
    assert CHANGES["2 pixels lower"](pixels)[0, 0, 10, 0] == 8
    assert CHANGES["2 pixels higher"](pixels)[0, 0, 10, 0] == 12


def test_the_command_tells_what_will_happen_on_the_car_and_ends_with_what_to_do(trained, call, tmp_path):
    run = trained(*TINY)
    words = ("evaluation.trials=1", "evaluation.time_s=1", "-o", "bad.png")
    ended = call("check", str(run.folder), "--car", *words)
    assert ended.code == 0, ended.stderr
    for words in ("of full lock", "100% throttle", "real-time factor", "zig-zag on straights", "edge cm"):
        assert words in ended.stdout
    for part in ("nothing", "picture", "timing", "controls", "all"):
        assert f"\n{part} " in ended.stdout
    last = ended.stdout.splitlines()[-1]
    assert last == "ready" or last.startswith("not ready: ")
    bad = "pictures  bad.png" in ended.stdout
    assert (ended.cwd / "bad.png").exists() == bad
    if bad:
        assert Image.open(ended.cwd / "bad.png").format == "PNG"


def test_what_cannot_drive_on_the_car_is_refused(trained, call):
    features = trained()
    call("check", str(features.folder), "--car").assert_refused("the car cannot run this policy")
    call("check", str(features.folder)).assert_refused("--car")
    call("check", str(features.folder), "--car", "evaluation=summit").assert_refused("evaluation=real_car")
    call("check", str(features.folder), "--car", "-o", "bad.jpg").assert_refused(".png")
