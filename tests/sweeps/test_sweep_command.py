"""`deepracer-exp sweep`, as typed."""

import shlex

import optuna
import pytest
import yaml
from optuna.trial import TrialState

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.runs.run_files import read_config, read_object
from deepracer_exp.sweeps.queue.storage import open_storage
from deepracer_exp.sweeps.report.best_trial import best_line, best_run
from deepracer_exp.sweeps.trial import Trial
from tests.training.conftest import assert_same_run

TINY = (
    *("sweep", "experiment=tiny", "tracking=off", "collector.threads=1", "checkpoints.every=1"),
    *("episode.max_steps=60", "budget.env_steps=null", "budget.iterations=2", "sweep.protocol=three_trials"),
    *("sweep.workers=1", "sweep.rerank_laps=2", "trace=full"),
    "algorithm.frames_per_iteration=256",
)
LR = "algorithm.lr=tag(log,interval(1e-5,1e-3))"
SERVER = "postgresql+psycopg://me:secret@127.0.0.1:1/none"


def load(cwd, name):
    return optuna.load_study(study_name=name, storage=open_storage(None, cwd / "runs"))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ((), ("nothing to search", "KEY='interval(LOW,HIGH)'")),
        ((LR, "sweep.workers=0"), ("sweep.workers=0",)),
        ((LR, "sweep.pruners=[median]", "sweep.objectives=[lap_time,completion]"), ("median", "several")),
        ((LR, "sweep.protocol=real_car"), ("real_car", "the car has no features of the road")),
        (("observation=camera,camera_small", "sweep.protocol=real_car"), ("observation=camera", "160x120")),
        ((LR, "randomization=real_car"), ("randomization.real_car", "the car has no features of the road")),
        ((LR, "seed=0,1"), ("sweep.seeds",)),
        (
            (LR, "sweep.clone={randomization: sim2reel}"),
            ("sweep.clone: randomization=", "did you mean sim2real?"),
        ),
        ((LR, "sweep.clone={network: mlp}"), ("sweep.clone: network: cannot be changed in a clone",)),
        ((LR, "sweep.clone={name: other}"), ("sweep: clone: name",)),
        ((LR, "sweep.clone={track: Monaco}"), ("sweep.clone: track: another one", "accepted: theirs")),
        ((LR, "parent=no_such_run"), ("parent=no_such_run",)),
        ((LR, "--storage", "sqlite:///x.db"), ("unrecognized arguments: --storage",)),
        ((LR, "sweep.storage=sqlite:////proc/x.db"), ("sweep.storage=", "/proc/x.db cannot be written")),
        ((LR, f"sweep.storage={SERVER}"), ("sweep.storage=postgresql+psycopg://", "127.0.0.1")),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_an_impossible_sweep_is_refused_before_anything_is_created(call, overrides, words):
    ended = call("sweep", *overrides)
    ended.assert_bad_input(*words)
    assert "secret" not in ended.stderr
    assert not list(ended.cwd.glob("runs/**/*")), "something was made"


def test_a_study_that_is_not_there_is_refused_before_the_sweep_starts(call):
    ended = call("sweep", "study=unknown")
    ended.assert_bad_input("nothing to search")
    assert "starting" not in ended.stderr


@pytest.fixture(scope="module")
def swept(tmp_path_factory, call_at, workers_start_early):
    """Return a folder in which a study of two trials was made."""
    folder = tmp_path_factory.mktemp("swept")
    ended = call_at(folder, *TINY, "study=s", LR, "sweep.trials=2")
    assert ended.code == 0, ended.stderr
    return ended


def test_a_trial_that_ends_is_a_line_with_what_it_drew_and_the_winner_one_that_trains_it(swept):
    lines = swept.stderr.splitlines()
    assert sum(": trial " in line and " done " in line for line in lines) == 2
    assert sum(line.startswith("  lr ") for line in lines) == 2
    (line,) = [line for line in swept.stdout.splitlines() if line.startswith("  deepracer-exp train ")]
    study = load(swept.cwd, "s")
    best = read_object(swept.cwd / "runs" / "s" / "best_of_sweep.json")
    trial = study.trials[best["trial"]]
    assert shlex.split(line)[2:] == trial.user_attrs["overrides"]
    # It says nothing of how a worker runs a trial, and all else that it makes is the trial's experiment.
    assert not [word for word in shlex.split(line) if word.startswith(("collector=", "report=", "name="))]
    own = compose_experiment(trial.user_attrs["overrides"])[1].mapping
    config = read_config(swept.cwd / "runs" / "s" / best["run_dir"])
    assert config["algorithm"]["lr"] == trial.params["algorithm.lr"]
    assert {key for key in config if config[key] != own[key]} <= {"collector", "name", "report", "runs_dir"}


@pytest.mark.usefixtures("workers_start_early")
def test_the_printed_command_repeats_the_winner_bit_for_bit(swept, call):
    study = load(swept.cwd, "s")
    ended = call(*shlex.split(best_line(study))[1:], "collector.processes=2")
    assert ended.code == 0, ended.stderr
    assert_same_run(best_run(study, swept.cwd / "runs"), ended.folder)


@pytest.mark.slow
def test_a_finished_study_makes_no_trial_again(swept, run_at):
    before = {path: path.stat().st_mtime_ns for path in swept.cwd.glob("runs/s/*/summary.json")}
    ended = run_at(swept.cwd, "sweep", "study=s")
    assert ended.code == 0, ended.stderr
    assert {path: path.stat().st_mtime_ns for path in swept.cwd.glob("runs/s/*/summary.json")} == before
    assert len(load(swept.cwd, "s").trials) == 2


def test_another_search_under_the_same_name_is_refused_with_the_difference(swept, call_at):
    ended = call_at(swept.cwd, *TINY, "study=s", LR.replace("1e-5", "1e-4"), "sweep.trials=2")
    ended.assert_refused("study=s: exists", "algorithm.lr", "1e-5", "1e-4")


def test_a_resumed_study_knows_its_search_and_names_the_keys_that_may_be_given(swept, call_at):
    shown = call_at(swept.cwd, "sweep", "study=s", "--cfg")
    assert shown.code == 0
    sweep = yaml.safe_load(shown.stdout)["sweep"]
    assert (sweep["trials"], sweep["space"]) == (2, {"algorithm.lr": LR.partition("=")[2]})
    load(swept.cwd, "s").set_user_attr("trials", 5)  # as `sweep.trials=5` leaves it
    assert yaml.safe_load(call_at(swept.cwd, "sweep", "study=s", "--cfg").stdout)["sweep"]["trials"] == 5
    load(swept.cwd, "s").set_user_attr("trials", 2)
    refused = call_at(swept.cwd, "sweep", "study=s", "sweep.pruners=[]")
    refused.assert_refused("study=s: exists; to resume it, give only", "runs_dir")


def test_report_and_best_need_no_more_than_the_name(swept, call_at):
    best = call_at(swept.cwd, "sweep", "best", "s")
    assert "deepracer-exp train " in best.stdout
    report = call_at(swept.cwd, "sweep", "report", "s")
    assert (swept.cwd / report.stdout.strip()).is_file()
    for words, said in ((("best", "t"), "studies: s"), (("study=ss",), "did you mean s?")):
        call_at(swept.cwd, "sweep", *words).assert_refused(said)


@pytest.mark.slow
def test_when_all_trials_fail_the_sweep_ends_early_with_their_error(start, tmp_path):
    # A trial lasts longer than the driver looks away, so that it sees the third failure before the fourth.
    (tmp_path / "broken.py").write_text(
        "import time\n\n\ndef reward_function(params):\n"
        "    time.sleep(2.0 * (params['steps'] >= 5))\n    return 1 / (params['steps'] < 5)\n"
    )
    ended = start(*TINY, "study=f", LR, "sweep.trials=30", "reward.file=broken.py").end()
    assert ended.code == 3, ended.stderr
    assert "all 3 trials so far failed" in ended.complaint
    assert "ZeroDivisionError" in ended.complaint
    states = [trial.state for trial in load(tmp_path, "f").trials]
    assert states.count(TrialState.FAIL) >= 3
    assert TrialState.PRUNED not in states
    assert all("ZeroDivisionError" in Trial.of(t).traceback for t in load(tmp_path, "f").trials[:3])
    failed = states.count(TrialState.FAIL)
    again = start("sweep", "study=f").end()
    assert again.code == 3, again.stderr
    assert "trials so far failed" in again.complaint
    assert [trial.state for trial in load(tmp_path, "f").trials].count(TrialState.FAIL) >= failed + 3


@pytest.mark.slow
def test_a_trial_that_kills_its_worker_each_time_fails_and_the_others_are_made(start, tmp_path):
    (tmp_path / "deadly.py").write_text(
        "import os\n\nDEADLY = 0\n\n\n"
        "def reward_function(params):\n"
        "    if DEADLY and params['steps'] > 4:\n"
        "        os.kill(os.getpid(), 9)\n"
        "    return params['speed']\n"
    )
    ended = start(
        *(*TINY, "study=d", "reward.constants.DEADLY=0,1", "sweep.sampler=grid", "sweep.trials=2"),
        "reward.file=deadly.py",
    ).end()
    assert ended.code == 0, ended.stderr
    states = {trial.params["reward.constants.DEADLY"]: trial.state for trial in load(tmp_path, "d").trials}
    assert states == {0: TrialState.COMPLETE, 1: TrialState.FAIL}
    (failed,) = load(tmp_path, "d").get_trials(states=(TrialState.FAIL,))
    assert failed.user_attrs["reason"].startswith("its worker was lost 3 times after iteration 0")
    assert failed.user_attrs["attempt"] == 4
