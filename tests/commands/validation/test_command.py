from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from deepracer_exp.aws.worlds.routes import world_rows
from deepracer_exp.commands.validation import validate as checking
from deepracer_exp.commands.validation.short_training import compare_thirds
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.reports.tables.line_file import racing_line_table, write_line
from deepracer_exp.rewards.source import zoo_names
from deepracer_exp.tracks.track import world_track

pytestmark = [pytest.mark.usefixtures("coarsely"), pytest.mark.processes]

REWARD = "def reward_function(params):\n    return {pay}\n"


def write(folder: Path, pay: str, name: str = "mine.py") -> str:
    (folder / name).write_text(REWARD.format(pay=pay), encoding="utf-8")
    return f"reward.file={name}"


def test_a_good_reward_ends_with_a_verdict_and_a_picture(call, tmp_path):
    ended = call("validate", "reward=progress_delta")
    assert ended.code == 0
    assert "deepracer-on-aws: would accept it" in ended.stdout
    assert "AWS console: its documentation forbids nothing in it" in ended.stdout
    assert ended.stdout.splitlines()[-1].startswith("Verdict: can be trained here")
    picture = tmp_path / "runs/validate/progress_delta-reinvent_base.png"
    assert picture.name in ended.stdout
    assert imread(picture).shape[1] > 400


def test_an_action_that_stops_the_car_is_driven_at_its_slowest_speed(call):
    speeds = ("action_space=continuous", "action_space.speed.low=0")
    ended = call("validate", "reward=speed_on_track", *speeds)
    assert ended.code == 0, ended.stderr


@pytest.mark.parametrize(
    ("track", "own"),
    [("track.file=oval.npy", False), ("track.file=square.yaml", True)],
)
def test_waypoint_numbers_that_no_world_has_are_noted(call, tmp_path, track, own):
    (tmp_path / "square.yaml").write_text("width_m: 0.8\nknots: [[0, 0], [4, 0], [4, 3], [0, 3]]\n")
    np.save(tmp_path / "oval.npy", world_rows("Oval_track") + 4e-5)
    ended = call("validate", "reward=speed_on_track", track)
    assert ("not as in a track of the service" in ended.stdout) == own
    assert {path.parent.name for path in tmp_path.rglob("*.png")} == {"validate"}


def test_a_line_pasted_into_a_reward_function_is_accepted(call, tmp_path):
    write_line(tmp_path / "mine.py", racing_line_table(world_track("reinvent_base")))
    uses = "1 / (0.1 + min(abs(params['x'] - point[0]) + abs(params['y'] - point[1]) for point in LINE))"
    with (tmp_path / "mine.py").open("a") as file:
        file.write("\n\n" + REWARD.format(pay=uses))
    ended = call("validate", "reward.file=mine.py", "--strict")
    assert ended.code == 0, ended.stdout
    assert "deepracer-on-aws: would accept it" in ended.stdout
    assert "style" not in ended.stdout


def test_what_aws_would_reject_is_reported_and_fails_with_strict(call, tmp_path):
    (tmp_path / "mine.py").write_text(
        "import os\n\n\n" + REWARD.format(pay="float(len(os.sep)) + params['speed']")
    )
    for extra, code in ((), 0), (("--strict",), 2):
        ended = call("validate", "reward.file=mine.py", *extra)
        assert ended.code == code
        assert "line 1: import of os" in ended.stdout
        assert "AWS console: its documentation forbids what is named first above" in ended.stdout
        assert "deepracer-on-aws would refuse it: 1 finding" in ended.stdout.splitlines()[-1]


def test_style_is_counted_apart_and_blamed_on_nobody_else(call, tmp_path):
    (tmp_path / "mine.py").write_text("import math\n" + REWARD.format(pay="math.sqrt(params['speed'])"))
    ended = call("validate", "reward.file=mine.py")
    assert "AWS console: its documentation forbids nothing in it" in ended.stdout
    assert "style (flake8" in ended.stdout
    assert "line 2: E302 expected 2 blank lines, found 0" in ended.stdout
    assert ended.stdout.splitlines()[-1].endswith("deepracer-on-aws would refuse it: 1 finding, 1 of style")


def test_what_cannot_be_used_here_exits_with_2_and_draws_nothing(call, tmp_path):
    ended = call("validate", write(tmp_path, "1 / (not params['is_offtrack'])"))
    assert ended.code == 2
    assert "failed" in ended.stdout
    assert ended.stdout.splitlines()[-1].startswith("Verdict: cannot be used: raised ZeroDivisionError")
    assert not list(tmp_path.rglob("*.png"))


TIMES = ("", "0s", "-5s", "20000steps", "inf", "1h")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("reward.file=nowhere.py",), ("nowhere.py", "No such file")),
        (("reward=progress_dleta",), ("progress_delta",)),
        (("reward.file=no_function.py",), ("no function reward_function", "reward_functoin")),
        (("reward.file=two_arguments.py",), ("must take one argument",)),
        (("reward.file=syntax.py",), ("line 2", "not valid Python")),
        (("trial=soon",), ("trial=soon", "trial=60s")),
        (("track=[reinvent_base,Oval_track]",), ("on one track; accepted",)),
        (("track=nowhere",), ("no such track",)),
        *(((f"trial={text}",), ("accepted: seconds or minutes above 0",)) for text in TIMES),
    ],
)
def test_bad_input_is_one_line(call, tmp_path, arguments, words):
    (tmp_path / "no_function.py").write_text("def reward_functoin(params):\n    return 1.0\n")
    (tmp_path / "two_arguments.py").write_text("def reward_function(a, b):\n    return 1.0\n")
    (tmp_path / "syntax.py").write_text("open('ran', 'w')\ndef reward_function(params)\n    return 1.0\n")
    call("validate", *arguments).assert_bad_input(*words)
    assert not (tmp_path / "ran").exists()


def test_a_picture_that_cannot_be_written_is_one_line(call):
    ended = call("validate", "reward=speed_on_track", "-o", "no/such/folder/map.png")
    assert ended.code == 2
    assert "--output no/such/folder/map.png: cannot be written" in ended.complaint


@pytest.mark.parametrize("track", ["Straight_track", "Bowtie_track"])
def test_open_and_crossing_tracks_are_drawn_too(call, tmp_path, track):
    ended = call("validate", "reward=follow_center_line", f"track={track}", "track.direction=reversed")
    assert ended.code == 0
    assert (tmp_path / f"runs/validate/follow_center_line-{track}.png").exists()


def test_a_continuous_action_space_and_a_single_action_are_fine(call):
    assert call("validate", "reward=speed_on_track", "action_space=continuous").code == 0
    one = "action_space.actions=[{steering_angle: 0, speed: 1}]"
    assert call("validate", "reward=speed_on_track", "action_space=discrete", one).code == 0


@pytest.mark.parametrize("name", zoo_names())
def test_every_reward_of_the_zoo_can_be_trained_here_and_by_deepracer_on_aws(name):
    check = checking.read(compose_experiment([f"reward={name}"])[0])
    # Which of the calls of SciPy's solver import something depends on the versions.
    wrong = [
        found
        for found in check.aws
        if name != "racing_line" or "while the function is called" not in found.text
    ]
    assert wrong == []
    checking.try_named_situations(check)
    checking.look_closer(check)
    assert check.failures == []
    assert not any("reward_batch" in line or "the last waypoint" in line for line in check.warnings)
    remember = ("progress_delta", "careful_progress", "avoid_objects", "free_lane", "overtake")
    assert check.state == ("earlier calls" if name in remember else "none")  # the progress of the last call


def test_a_short_training_reports_whether_anything_improves(call, tmp_path):
    ended = call(
        *("validate", write(tmp_path, "params['speed'] - 9 * params['is_offtrack']"), "trial=1s"),
        *("experiment=tiny", "collector=in_process", "collector.threads=1"),
    )
    assert ended.code == 0, ended.stderr
    assert "Trial: " in ended.stdout
    assert "runs/validate/" in ended.stdout
    assert len(list(tmp_path.glob("runs/validate/*/metrics.jsonl"))) == 1
    assert "improve" in ended.stdout


def rows(completion: list[float | None], reward: list[float]) -> list[dict]:
    return [
        {"completion": c, "mean_return": r, "episodes": 10 * (i + 1)}
        for i, (c, r) in enumerate(zip(completion, reward, strict=True))
    ]


def test_a_rise_beyond_noise_is_an_improvement():
    noise = np.random.default_rng(0).normal(0, 3, 30)
    completion, reward = compare_thirds(rows([*(np.linspace(10, 80, 30) + noise)], [*(50 + noise)]))
    assert completion.startswith("per cent of the lap improves: ")
    assert "in the first third (100 episodes)" in completion
    assert reward.startswith("reward of an episode does not improve: ")


def test_iterations_without_an_episode_count_for_nothing_and_few_say_nothing():
    completion, _ = compare_thirds(rows([None, 5, 6, 7, 8, 9, 50, None, 60], [1.0] * 9))
    assert "improves: 5.5 in the first third" in completion
    assert "55 in the last" in completion
    assert [compare_thirds(rows([1.0] * n, [1.0] * n)) for n in (0, 1, 5)] == [[], [], []]
