"""What ends a run, and what is reported of it: stopping rules and budgets in real trainings."""

import os
import re
import shlex
import shutil
import signal
import threading

import numpy as np
import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.setup import build_courses
from deepracer_exp.reports.findings import findings
from deepracer_exp.reports.pages.run_page import write_pictures
from deepracer_exp.reports.tables.log_tables import headline
from deepracer_exp.reports.tables.log_view import prepare
from deepracer_exp.runs.recording import read_run_recording
from deepracer_exp.training.stopping.stopping_rules import build_rule
from tests.conftest import OFTEN, THREE
from tests.waiting import wait_until

NOT_LEARNING = (
    *("stopping=entropy", "stopping.window=1", "stopping.converged=null", "stopping.collapsed=null"),
    *("stopping.not_learning.warmup=0", "stopping.not_learning.patience=2", "algorithm.lr=1e-9"),
    *("stopping.not_learning.completion_gain=50", "stopping.not_learning.completion_poor=100"),
)


def test_a_run_that_does_not_learn_is_stopped_early(trained):
    ended = trained(*NOT_LEARNING)
    assert ended.code == 0, ended.stderr
    assert ended.summary["status"] == "stopped early"
    assert ended.summary["reason"].startswith("not learning: entropy still at 100.0%")
    assert ended.summary["iteration"] == 3
    assert ended.stdout.startswith("\nstopped early: not learning: ")
    stopping = ended.summary["stopping"]
    assert (stopping["rule"], stopping["stopped_early"]) == ("not_learning", True)
    assert stopping["thresholds"]["patience"] == 2
    assert 0.99 < stopping["values"]["entropy"] <= 1


def test_the_rule_comes_to_the_runs_decision_by_the_rows_of_its_metrics_alone(trained):
    ended = trained(*NOT_LEARNING)
    experiment = compose_experiment(NOT_LEARNING)[0]
    rule = build_rule(experiment.stopping, build_action_space(experiment.action_space).n)
    *before, last = [rule.observe(row) for row in ended.metrics]
    assert before == [None] * len(before)
    assert last.as_dict() == ended.summary["stopping"]


@pytest.mark.processes
def test_a_budgets_alerts_go_to_the_log_and_the_command(trained, tmp_path):
    command = tmp_path / "alert.sh"
    command.write_text('echo "$1" >> alerts.txt\n')
    ended = trained(*OFTEN, "budget.env_steps=1024", f"budget.alert_command=sh {command}")
    # Commands run beside the training and each other.
    sent = sorted((ended.cwd / "alerts.txt").read_text().splitlines())
    assert sent == [
        "100% of budget.env_steps used: 1,024 steps of 1,024 steps",
        "50% of budget.env_steps used: 512 steps of 1,024 steps",
    ]
    log = (ended.folder / "log.txt").read_text()
    assert all(message in log for message in sent)


def ctrl_c_after(iterations, folder) -> None:
    """Send Ctrl-C to this process as soon as a run below a folder has as many iterations."""

    def recorded() -> bool:
        files = list(folder.glob("runs/*/*/metrics.jsonl"))
        return bool(files) and files[0].read_text().count("\n") >= iterations

    wait_until(recorded, f"{iterations} iterations")
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("end", ["budget", "ctrl-c"])
def test_wherever_a_run_ends_its_last_policy_is_evaluated_and_all_name_the_same_best_one(
    train_here, call, tmp_path, end
):
    own = (*OFTEN, "checkpoints.every=1000000", "stopping=none")
    if end == "budget":
        ended = train_here(*own, *THREE)
    else:
        threading.Thread(target=ctrl_c_after, args=(3, tmp_path)).start()
        ended = train_here(*own, "budget.env_steps=100000000")
        assert ended.code == 130
        assert "stopping: this iteration is finished" in ended.stderr
        assert re.search(rf" resume \S+/{ended.folder.name}\s", ended.stdout)
    last, best = ended.metrics[-1], ended.summary["best"]
    assert last["iteration"] % 1_000_000 != 0
    assert best["iteration"] == last["iteration"]
    assert best["eval_completion"] == last["eval_completion"] is not None
    assert str((ended.folder / "checkpoints" / "best").readlink()) == f"{best['iteration']:06d}"
    name = f"checkpoint {best['iteration']}"
    assert f"  best by race score (usual and held-out): {name}\n" in ended.stdout
    assert f"completion {best['eval_completion']:.0f}%" in ended.stdout
    found = findings(prepare(read_run_recording(ended.folder)))
    (submit,) = [one.sentence for one in found if one.rule == "submit"]
    assert submit.startswith(f"Race with {name}, the best by race score (usual and held-out): ")
    compared = call("checkpoints", ended.folder.name)
    assert compared.code == 0, compared.stderr
    assert f"recommended: {name}: " in compared.stdout


def test_the_lines_to_paste_after_a_training_work(trained, copied, call):
    limits = (*OFTEN, "budget.iterations=1", "budget.env_steps=1")  # reached by the same iteration
    run = copied(*limits)
    # One of another experiment that began in the same second.
    shutil.copytree(run, run.parents[1] / "other" / run.name, symlinks=True)
    ended = trained(*limits)
    begin = ended.stdout.index("\n  next\n")
    shown = [shlex.split(line, comments=True) for line in ended.stdout[begin:].splitlines()[2:]]
    lines = [line for line in shown if line]  # in a narrow terminal, what a command does stands above it
    assert [line[1] for line in lines] == ["evaluate", "evaluate", "clone", "resume"]
    for line in lines:
        if "--video" not in line:  # needs a renderer
            assert call(*line[1:]).code == 0, line


@pytest.mark.parametrize(
    "overrides",
    [(), ("track=[reinvent_base,Oval_track]", "race=object_avoidance", "observation.next_objects=2")],
    ids=" ".join,
)
def test_a_run_has_pictures_as_soon_as_it_has_an_iteration(train_here, tmp_path, overrides):
    write_pictures(tmp_path, build_courses(compose_experiment([])[0]), np.ones(256, bool))
    assert not list(tmp_path.iterdir())
    ended = train_here("budget.iterations=1", *overrides)  # without a lap
    assert ended.code == 0, ended.stderr
    for name in ("best_lap.png", "learning.png"):
        assert (ended.folder / name).read_bytes().startswith(b"\x89PNG\r\n\x1a\n")


def test_the_page_counts_the_episodes_that_the_summary_counts(trained):
    ended = trained("budget.iterations=1")
    view = prepare(read_run_recording(ended.folder))
    assert len(view.episodes) > ended.summary["episodes"] > 0  # some were still being driven at the end
    assert f" in {ended.summary['episodes']} finished episodes and 1 iteration" in headline(view)
