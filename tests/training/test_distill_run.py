"""`algorithm=distill teacher=RUN`: an ordinary run that begins with another one's policy as its teacher."""

import shutil

import pytest

from deepracer_exp.runs.files import read_config, read_metrics
from tests.conftest import IN_PROCESS

from .conftest import assert_same_run

DISTILL = (
    *("observation=camera_small", "algorithm=distill", "algorithm.teacher_iterations=2", "collector.cars=8"),
    *("algorithm.frames_per_iteration=256", "checkpoints.every=2", "evaluation.time_s=4"),
    "budget.env_steps=null",
)
TAUGHT = ("algorithm=distill", "teacher=school/teacher")


@pytest.fixture
def teacher(copied, tmp_path):
    (tmp_path / "school").mkdir()
    return copied().rename(tmp_path / "school" / "teacher")


def test_it_is_resumed_bit_for_bit_without_the_teachers_folder_and_cloned_without_a_teacher(
    teacher, call, tmp_path
):
    line = (*IN_PROCESS, *DISTILL, "teacher=school/teacher")
    for name, iterations in (("whole", 4), ("cut", 1)):
        ended = call("train", *line, f"name={name}", f"budget.iterations={iterations}")
        assert ended.code == 0, ended.stderr
    (whole,), (cut,) = (list((tmp_path / "runs").glob(f"{name}/*")) for name in ("whole", "cut"))
    shutil.rmtree(teacher)
    resumed = call("resume", str(cut), "budget.iterations=4")
    assert resumed.code == 0, resumed.stderr
    assert_same_run(whole, cut)
    divergence = [row["policy_loss"] for row in read_metrics(whole / "metrics.jsonl")]
    assert min(divergence[:2]) > 10 * max(map(abs, divergence[2:]))

    cloned = call("clone", str(whole), "budget.iterations=1", "tracking=off", "name=clone")
    assert cloned.code == 0, cloned.stderr
    (clone,) = (tmp_path / "runs").glob("clone/*")
    config = read_config(clone)
    assert (config["teacher"], config["algorithm"]["teacher_iterations"]) == (None, 0)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("algorithm=distill",), ("teacher", "algorithm=distill", "teacher=RUN")),
        (("teacher=school/teacher",), ("teacher", "algorithm=distill")),
        (("algorithm=distill", "teacher=nowhere"), ("nowhere", "no such run")),
        ((*TAUGHT, "action_space=discrete"), (*TAUGHT[1:], "actions")),
        ((*TAUGHT, "observation.lookahead_m=[1]"), (*TAUGHT[1:], "features")),
    ],
)
def test_what_cannot_be_taught_is_refused_in_one_line(teacher, call, overrides, words):
    call("train", *IN_PROCESS, *overrides).assert_bad_input(*words)


def test_a_sweep_finds_the_teacher_before_its_trials_begin(teacher, call):
    line = ("sweep", "algorithm=distill", "algorithm.lr=interval(1e-4,1e-3)", "--cfg")
    assert call(*line, "teacher=school/teacher").code == 0
    call(*line, "teacher=nowhere").assert_bad_input("nowhere", "no such run")
