"""The last stage of `deepracer-exp sweep`: the best trial is cloned, and the clone races."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import pytest

from deepracer_exp.config.sweep import compose_sweep
from deepracer_exp.runs.lineage import read_lineage
from deepracer_exp.runs.run_files import read_config, read_object
from deepracer_exp.sweeps.last_stage import LastStage
from deepracer_exp.sweeps.queue.study import known_settings
from deepracer_exp.sweeps.report.best_trial import best_run, best_trial
from deepracer_exp.sweeps.report.last_race import last_race, store_last_race, write_submitted
from deepracer_exp.sweeps.search.space import SearchSpace
from deepracer_exp.sweeps.trial import Interrupted
from deepracer_exp.tracking.resolve import resolve

from .test_sweep_command import LR, TINY, load

CLONE = "sweep.clone={randomization: sim2real, budget.iterations: 2}"


def runs_of(cwd):
    return {path.parent.name for path in cwd.glob("runs/s/*/config.yaml")}


@pytest.fixture(scope="module")
def cloned(tmp_path_factory, call_at, workers_start_early):
    """Return a folder in which a study of two trials was made, and the best one cloned."""
    ended = call_at(tmp_path_factory.mktemp("cloned"), *TINY, "study=s", LR, "sweep.trials=2", CLONE)
    assert ended.code == 0, ended.stderr
    return ended


def test_the_clone_is_a_run_of_its_own_whose_parent_is_the_best_trial(cloned):
    study = load(cloned.cwd, "s")
    (clone,) = (cloned.cwd / "runs" / "s").glob("*-clone1")
    best = best_run(study, cloned.cwd / "runs")
    lineage = read_lineage(clone)
    assert lineage is not None
    assert (lineage.parent, lineage.checkpoint) == (
        best.name,
        (best / "checkpoints" / "best").resolve().name,
    )
    config, before = read_config(clone), read_config(best)
    assert config["randomization"] != before["randomization"]
    assert config["algorithm"]["lr"] == pytest.approx(before["algorithm"]["lr"] / 10)
    assert (config["report"], config["trace"]) == (True, "full")
    assert {key: read_object(clone / "summary.json").get(key) for key in ("status", "study", "trial")} == {
        "status": "finished",
        "study": "s",
        "trial": None,
    }


def test_another_sweep_begins_with_the_settings_of_the_clones_trial(cloned):
    (clone,) = (cloned.cwd / "runs" / "s").glob("*-clone1")
    request = compose_sweep(["study=t", LR, f"sweep.enqueue=[{clone}]"])
    assert known_settings(request, SearchSpace.from_request(request)) == [
        best_trial(load(cloned.cwd, "s")).params
    ]


def test_the_clone_the_best_and_the_second_best_trial_race_and_the_best_of_them_is_the_runs_name(cloned):
    study = load(cloned.cwd, "s")
    race = last_race(study)
    assert race is not None
    assert sorted((one.trial, one.is_clone) for one in race.racers) == sorted(
        [(0, False), (1, False), (best_trial(study).number, True)]
    )
    first = race.racers[0]
    assert resolve("best:s", cloned.cwd / "runs", None).path.name == first.run
    assert first.checkpoint in {path.name for path in (cloned.cwd / "runs" / "s" / first.run).rglob("0*")}
    said = cloned.stdout
    assert race.verdict() in said
    assert "deepracer-exp export best:s format=aws" in said
    assert "What to submit, and why" in (cloned.cwd / "runs" / "s" / "sweep.html").read_text()


def test_the_run_to_submit_stays_where_a_repeated_sweep_is_interrupted(
    cloned, call_at, tmp_path, monkeypatch
):
    shutil.copytree(cloned.cwd / "runs", tmp_path / "runs", symlinks=True)
    page, best = (tmp_path / "runs" / "s" / name for name in ("sweep.html", "best_of_sweep.json"))
    # Whichever of the two won in these few steps: the run to submit is the clone.
    race = last_race(load(tmp_path, "s"))
    clone = next(racer for racer in race.racers if racer.is_clone)
    store_last_race(load(tmp_path, "s"), replace(race, racers=(clone, *race.racers)))
    write_submitted(load(tmp_path, "s"), tmp_path / "runs", last_race(load(tmp_path, "s")))

    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(LastStage, "run", interrupted)
    assert call_at(tmp_path, "sweep", "study=s").code == 130
    assert json.loads(best.read_text())["run_dir"] == clone.run
    assert "What to submit, and why" in page.read_text()


@pytest.mark.processes
def test_a_sweep_waits_for_another_one_in_the_last_stage_of_the_study_and_ctrl_c_ends_the_wait(tmp_path):
    shown: list[str] = []

    def check(*_: object) -> None:
        if len(shown) == 2:
            raise Interrupted

    def stage(check: Callable[..., None]) -> LastStage:
        view = SimpleNamespace(show=lambda _, what: shown.append(what))
        return LastStage(SimpleNamespace(folder=tmp_path), SimpleNamespace(), False, view, list, check)

    with stage(print)._alone():
        shown.clear()
        with pytest.raises(Interrupted), stage(check)._alone():
            pass
        assert shown == ["waits for the sweep that has begun the last stage"] * 2
    with stage(print)._alone():
        pass


@pytest.mark.slow
def test_the_same_command_clones_again_only_with_other_overrides(cloned, run_at):
    before = runs_of(cloned.cwd)
    again = run_at(cloned.cwd, "sweep", "study=s")
    assert again.code == 0, again.stderr
    assert runs_of(cloned.cwd) == before
    assert "Submit" in again.stdout
    other = run_at(cloned.cwd, "sweep", "study=s", "sweep.clone={budget.iterations: 2}")
    assert other.code == 0, other.stderr
    assert len(runs_of(cloned.cwd) - before) == 1
    without = run_at(cloned.cwd, "sweep", "study=s", "sweep.clone=null")
    assert without.code == 0, without.stderr
    assert "Submit" not in without.stdout


@pytest.mark.slow
def test_a_clone_that_fails_is_one_line_and_the_best_trial_stays_the_best(start, tmp_path):
    (tmp_path / "broken.py").write_text(
        "def reward_function(params):\n    return 1 / (params['steps'] < 5)\n", encoding="utf-8"
    )
    ended = start(*TINY, "study=s", LR, "sweep.trials=2", "sweep.clone={reward.file: broken.py}").end()
    assert ended.code == 3, ended.stderr
    assert ended.complaint.startswith("deepracer-exp: the clone of trial ")
    assert "ZeroDivisionError" in ended.complaint
    assert "`deepracer-exp sweep study=s` resumes it" in ended.complaint
    best = json.loads((tmp_path / "runs" / "s" / "best_of_sweep.json").read_text())
    assert not best["run_dir"].endswith("clone1")
    assert "What to submit" not in (tmp_path / "runs" / "s" / "sweep.html").read_text()
