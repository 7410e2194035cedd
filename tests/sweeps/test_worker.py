"""Trials made by a worker in a real database, without their trainings."""

import contextlib
import time
from types import SimpleNamespace

import optuna
import pytest
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.config.compose import compose_evaluation, compose_experiment
from deepracer_exp.config.sweep import compose_sweep
from deepracer_exp.reports.pages import run_page
from deepracer_exp.sweeps.queue.claims import TrialClaims
from deepracer_exp.sweeps.queue.storage import Database, open_storage
from deepracer_exp.sweeps.queue.study import open_study
from deepracer_exp.sweeps.queue.trial_run import TrialRun
from deepracer_exp.sweeps.queue.worker import Worker
from deepracer_exp.sweeps.queue.worker_config import WorkerConfig
from deepracer_exp.sweeps.search.space import SearchSpace
from deepracer_exp.sweeps.trial import Trial
from deepracer_exp.tracking.projector import Projector
from deepracer_exp.training.signals import Interruption

SPACE = {
    "grid": ("algorithm.lr=1e-4,3e-4,1e-3", "network=mlp_small,mlp"),
    "cmaes": ("algorithm.lr=tag(log,interval(1e-5,1e-3))", "algorithm.entropy_coeff=interval(0,0.05)"),
}
MIXED = ("algorithm.lr=tag(log,interval(1e-5,1e-3))", "network=mlp_small,mlp")


def worker(tmp_path, *asked: str) -> tuple[Worker, RDBStorage]:
    """Begin a sweep and return a worker of it, with the database."""
    overrides = [*asked, "tracking=off"]
    request = compose_sweep([*overrides, "study=s"])
    space = SearchSpace.from_request(request)
    storage = open_storage(None, tmp_path)
    open_study(request, overrides, space, None, storage, tmp_path)
    config = WorkerConfig(
        study="s",
        runs_dir=tmp_path,
        config=request.entry.sweep,
        protocol=compose_evaluation(["evaluation=sweep"])[0].evaluation,
        space=space,
        parent=None,
        store=None,
        study_run_id=None,
        evaluations=None,
        cores=1,
    )
    return Worker(config, storage, "host:1:a", Projector()), storage


def untrained(self: TrialRun, overrides) -> Trial:
    return self._as_trial("COMPLETE", [9.0 + len(overrides)])


def made(tmp_path, monkeypatch, *asked: str) -> list[FrozenTrial]:
    """Make the trials of a sweep, with nearly the same values and without training."""
    monkeypatch.setattr(TrialRun, "_ended", untrained)
    one, storage = worker(tmp_path, *asked, "sweep.startup_trials=2")
    one.work(Interruption())
    return optuna.load_study(study_name="s", storage=storage).trials


@pytest.mark.processes
@pytest.mark.parametrize("sampler", ["tpe", "gp", "cmaes", "random", "grid", "optuna.samplers:NSGAIISampler"])
def test_with_every_sampler_all_trials_draw_their_values_and_are_reported(sampler, tmp_path, monkeypatch):
    searched = SPACE.get(sampler, MIXED)
    trials = made(tmp_path, monkeypatch, *searched, f"sweep.sampler={sampler}", "sweep.trials=3")
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 3, trials[0].user_attrs
    assert all(set(trial.params) == {one.partition("=")[0] for one in searched} for trial in trials)
    assert len({tuple(trial.params.values()) for trial in trials}) == 3


@pytest.mark.processes
def test_values_drawn_again_are_trained_with_the_next_seed(tmp_path, monkeypatch):
    asked = ("network=mlp_small,mlp", "seed=7", "sweep.sampler=random", "sweep.trials=6", "sweep.seeds=2")
    seeds: dict[str, list[int]] = {}
    for trial in made(tmp_path, monkeypatch, *asked):
        experiment, _ = compose_experiment(trial.user_attrs["overrides"])
        seeds.setdefault(trial.params["network"], []).append(experiment.seed)
    assert sorted(map(len, seeds.values()))[-1] >= 3
    for found in seeds.values():
        assert found == [7 + 2 * again for again in range(len(found))]


def test_a_worker_lost_before_it_created_its_trial_leaves_no_gap_and_changes_no_value(tmp_path, monkeypatch):
    asked = ("algorithm.lr=interval(1e-5,1e-3)", "sweep.sampler=random", "sweep.trials=4")
    undisturbed = made(tmp_path / "undisturbed", monkeypatch, *asked)
    one, storage = worker(tmp_path / "disturbed", *asked)
    claims = TrialClaims(storage.engine, "s")
    assert claims.claim("host:2:lost", 4, 3600.0).trial.number == 0
    late = SimpleNamespace(sleep=lambda _: claims.release("host:2:lost"), monotonic=time.monotonic)
    monkeypatch.setattr("deepracer_exp.sweeps.queue.worker.time", late)
    one.work(Interruption())
    trials = optuna.load_study(study_name="s", storage=storage).trials
    assert [claim.attempt for claim in claims.all()] == [2, 1, 1, 1]
    assert [Trial.of(trial) for trial in trials] == [claim.trial for claim in claims.all()]
    assert [trial.params for trial in trials] == [trial.params for trial in undisturbed]


@pytest.mark.processes
def test_a_trial_that_another_worker_creates_meanwhile_is_not_created_again(tmp_path, monkeypatch):
    one, storage = worker(
        tmp_path, "algorithm.lr=interval(1e-5,1e-3)", "sweep.sampler=random", "sweep.trials=2"
    )
    study_id = storage.get_study_id_from_name("s")
    created: list[int] = []

    @contextlib.contextmanager
    def waited_for(*_: object):
        created.append(storage.create_new_trial(study_id))
        yield

    monkeypatch.setattr(Database, "creation_lock", waited_for)
    assert [one._trial_id(0)] == created
    assert storage.get_n_trials(study_id) == 1


def test_a_run_whose_trial_is_taken_over_while_its_pictures_are_drawn_has_no_end(tmp_path, monkeypatch):
    one, storage = worker(
        tmp_path,
        "experiment=tiny",
        "network=mlp_small,mlp",
        "sweep.trials=1",
        "sweep.lease_s=1",
        "sweep.rerank=0",
    )
    claims, until = TrialClaims(storage.engine, "s"), SimpleNamespace(signum=None)

    def drawn(*_: object) -> None:
        taken = None
        while taken is None:  # the worker may renew its lease between the two
            claims.release("host:1:a", is_lost=True)
            taken = claims.claim("host:2:b", 1, 3600.0)
        assert taken.attempt == 2
        time.sleep(1.0)
        until.signum = 15

    monkeypatch.setattr(run_page, "write_pictures", drawn)
    one.work(until)
    (run,) = (tmp_path / "s").glob("*-seed*")
    assert (run / "metrics.jsonl").is_file()
    assert not (run / "summary.json").exists()
    assert [claim.has_ended for claim in claims.all()] == [False]
