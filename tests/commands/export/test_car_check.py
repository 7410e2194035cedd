"""The check before a drive with the physical car."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console
from tensordict import TensorDict

from deepracer_exp.commands.export.car_check import CAR, SIMULATOR, CarCheck, CarLaps, print_check
from deepracer_exp.commands.export.car_converter import Conversion
from deepracer_exp.commands.export.car_export import CarArchive, car_actions
from deepracer_exp.config.compose import compose_evaluation, compose_experiment
from deepracer_exp.config.driving import CameraConfig
from deepracer_exp.env.action_space import DiscreteActions
from deepracer_exp.evaluation.race_protocol import Attempt
from deepracer_exp.evaluation.results import USUAL, Evaluation, TrialGroup
from deepracer_exp.evaluation.zigzag import ZigZag
from deepracer_exp.reports.pages.picture_changes import CHANGES, pictures_sheet, spread_out, try_pictures

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


def check(pictures=(200,), network_s=0.001, zigzag=STEADY, same=1.0, **shares):
    policy = Threshold(100)
    driven = {name: laps(shares.get(name, 1.0), zigzag) for name in (SIMULATOR, "picture", "controls", CAR)}
    tried = try_pictures(policy, seen(policy, *pictures), ACTIONS)
    conversion = None if same is None else Conversion(np.arange(200) < 200 * same, 0.001)
    return CarCheck(driven, network_s, 1 / 30, tried, conversion)


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
        ({"same": 0.97}, "same action on 194 of 200 pictures, wanted 99%"),
    ],
)
def test_each_fault_alone_makes_it_not_ready_and_says_what_to_do(found, words):
    (step,) = check(**found).to_do()
    assert words in step


def test_a_converter_that_is_not_installed_is_no_fault():
    assert check(same=None).to_do() == []


def printed(found, columns, is_terminal):
    experiment, _ = compose_experiment(["experiment=real_car"])
    config = compose_evaluation(["evaluation=real_car"])[0].evaluation
    archive = CarArchive({}, car_actions(ACTIONS)[0], ["a note that does not fit a line of a terminal " * 3])
    file = io.StringIO()
    out = Console(file=file, width=columns, force_terminal=is_terminal, color_system=None)
    print_check(found, archive, experiment, config, out)
    return [line.rstrip() for line in file.getvalue().splitlines()]


@pytest.mark.parametrize("columns", [80, 100, 160])
def test_rows_of_its_tables_are_one_line_each_and_sentences_break_between_words(columns):
    lines = printed(check(pictures=(200, 110), zigzag=SWERVING), columns, True)
    assert max(map(len, lines)) <= columns
    assert not any("…" in line for line in lines)
    for what, found, wanted in (
        ("real-time factor", "33.3", "at least 4"),
        ("zig-zag on straights", "2.00 a metre, 20 degrees", "below 1 or 5 degrees"),
        ("pictures that decide badly", "1 of 2 (50%)", "at most 5%"),
        ("same action in OpenVINO", "200 of 200 (100%)", "at least 99%"),
    ):
        (line,) = [line for line in lines if line.startswith(f"{what} ")]
        assert line.split(what)[1].split("  ")[-1].strip() == wanted
        assert found in line
    whole = printed(check(pictures=(200, 110), zigzag=SWERVING), 160, False)
    assert " ".join(" ".join(lines).split()) == " ".join(" ".join(whole).split())


def test_in_a_pipe_each_sentence_is_one_line():
    lines = printed(check(same=None), 80, False)
    assert sum("a note that" in line for line in lines) == 1
    assert any(line.endswith("pip install 'deepracer-exp[car]'") for line in lines)


def test_what_fails_in_the_simulator_is_not_blamed_on_the_car():
    steps = check(**{SIMULATOR: 0.5, "picture": 0.4, "controls": 0.4, CAR: 0.3}).to_do()
    assert len(steps) == 1
    assert "in the simulator" in steps[0]


def test_a_policy_that_has_not_learned_to_drive_is_to_be_trained_and_not_cloned():
    nothing = {name: 0.0 for name in (SIMULATOR, "picture", "controls", CAR)}
    (step,) = check(pictures=(200, 110), zigzag=SWERVING, **nothing).to_do()
    assert "deepracer-exp resume RUN budget.env_steps=N" in step
    assert "clone" not in step


def test_only_pictures_in_which_a_small_change_turns_the_wheels_decide_badly():
    policy = Threshold(100)
    tried = try_pictures(policy, seen(policy, 200, 110, 40, 90), ACTIONS)
    assert sorted(tried.bad) == [1, 3]  # 110 * 0.8 and 90 * 1.25 lie on the other side of 100
    assert tried.words() == "2 of 4 (50%)"
    assert tried.by_change() == "darker 1, brighter 1"
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
    assert "  driving in the simulator\n" in ended.stderr
    (file,) = [line.split()[1] for line in ended.stdout.splitlines() if line.startswith("  results ")]
    parts = json.loads(Path(file).read_text())["real_car"]
    assert list(parts) == [SIMULATOR, "picture", "timing", "controls", CAR]
    assert all(0 <= part["completion"] <= 1 for part in parts.values())
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
