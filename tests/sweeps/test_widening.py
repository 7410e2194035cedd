"""A study is given a wider search, and settings to begin with, in real databases and without trainings."""

from types import SimpleNamespace

import optuna
import pytest
from optuna.distributions import CategoricalDistribution
from optuna.trial import TrialState

from deepracer_exp.config.compose import compose_evaluation
from deepracer_exp.config.sweep import compose_sweep
from deepracer_exp.rewards.source import load_reward_source
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.sweeps.queue.claims import TrialClaims
from deepracer_exp.sweeps.queue.storage import open_storage
from deepracer_exp.sweeps.queue.study import (
    complete_widening,
    enqueue,
    known_settings,
    open_study,
    with_stored,
)
from deepracer_exp.sweeps.queue.trial_run import TrialRun
from deepracer_exp.sweeps.queue.worker import Worker
from deepracer_exp.sweeps.queue.worker_config import WorkerConfig
from deepracer_exp.sweeps.search.space import SearchSpace
from deepracer_exp.tracking.projector import Projector
from deepracer_exp.training.signals import Interruption
from tests.conftest import refused

LR = "algorithm.lr=tag(log,interval(1e-5,1e-3))"
NETWORK = "network=mlp_small,mlp"
in_a_file = pytest.mark.parametrize("url", ["sqlite"], indirect=True)


@pytest.fixture(autouse=True)
def untrained(monkeypatch):
    monkeypatch.setattr(
        TrialRun, "_ended", lambda self, overrides: self._as_trial("COMPLETE", [9.0 + self._number])
    )


@pytest.fixture
def storage(url, tmp_path):
    return open_storage(url, tmp_path)


@pytest.fixture
def started(url, storage, tmp_path):
    """Return a function that begins or continues the study as its driver does, and returns it with a worker."""

    def start(*asked, runs_dir=tmp_path):
        overrides = [*asked, "tracking=off", "study=s", f"sweep.storage={url}", "sweep.startup_trials=2"]
        request = compose_sweep([*overrides, f"runs_dir={runs_dir}"])
        space = SearchSpace.from_request(request)
        known = known_settings(request, space)
        complete_widening("s", storage)
        study = open_study(request, overrides, space, None, storage, runs_dir)
        enqueue(study, known)
        config = WorkerConfig(
            study="s", runs_dir=runs_dir, config=request.entry.sweep,
            protocol=compose_evaluation(["evaluation=sweep"])[0].evaluation,
            space=space, parent=None, store=None, study_run_id=None, evaluations=None, cores=1,
        )  # fmt: skip
        return study, Worker(config, storage, "host:1:a", Projector())

    return start


@pytest.fixture
def made(started):
    def make(*asked):
        study, worker = started(*asked)
        worker.work(Interruption())
        return study.get_trials()

    return make


@in_a_file
def test_a_study_goes_on_with_its_overrides_in_any_order_and_its_runs_elsewhere(started, tmp_path):
    study, _ = started(LR, "seed=3", "budget.iterations=2")
    again, _ = started("budget.iterations=2", LR, "seed=3")
    assert again.user_attrs["runs_dir"] == study.user_attrs["runs_dir"] == str(tmp_path)
    moved, _ = started(LR, "budget.iterations=2", "seed=3", runs_dir=tmp_path / "moved")
    assert moved.user_attrs["runs_dir"] == str(tmp_path / "moved")
    assert "every trial: seed=3 -> seed=4" in refused(started, LR, "budget.iterations=2", "seed=4")


def test_a_search_with_another_choice_and_a_wider_interval_keeps_the_trials(made):
    before = made(LR, NETWORK, "sweep.trials=4")
    after = made(
        "algorithm.lr=tag(log,interval(1e-6,1e-2))", "network=mlp,mlp_small,mlp_deep", "sweep.trials=6"
    )
    assert [trial.number for trial in after] == list(range(6))
    for old, kept in zip(before, after[:4], strict=True):
        assert (kept.params, kept.values, kept.state) == (old.params, old.values, old.state)
        assert kept.user_attrs == old.user_attrs
        assert kept.datetime_complete == old.datetime_complete
    assert {trial.distributions["network"] for trial in after} == {
        CategoricalDistribution(("mlp", "mlp_small", "mlp_deep"))
    }
    assert made(
        "algorithm.lr=tag(log,interval(1e-6,1e-2))", "network=mlp,mlp_small,mlp_deep", "sweep.trials=6"
    )


@in_a_file
def test_a_key_that_was_fixed_gets_the_value_that_trials_were_trained_with(made):
    made(LR, "algorithm.entropy_coeff=0.02", "network=mlp_small", "sweep.trials=3")
    after = made(
        LR, "algorithm.entropy_coeff=interval(0,0.05)", NETWORK, "algorithm.epochs=20,30", "sweep.trials=5"
    )
    for kept in after[:3]:
        assert (kept.params["algorithm.entropy_coeff"], kept.params["network"]) == (0.02, "mlp_small")
        # Trained with a number of epochs that is not searched.
        assert kept.params.keys() == {"algorithm.lr", "algorithm.entropy_coeff", "network"}
    assert all(len(trial.params) == 4 for trial in after[3:])


@in_a_file
def test_a_search_that_leaves_something_out_or_changes_every_trial_is_refused(made, started):
    before = made(LR, NETWORK, "sweep.trials=2")
    for asked in (
        ("algorithm.lr=tag(log,interval(1e-4,1e-3))", NETWORK),
        ("algorithm.lr=interval(1e-5,1e-3)", NETWORK),
        (LR, "network=mlp,mlp_deep"),
        (LR,),
        (LR, "network=mlp_small,mlp,mlp_deep", "track=Oval_track"),
        (LR, "network=mlp_small,mlp,mlp_deep", "sweep.seeds=2"),
    ):
        assert "exists with another search" in refused(started, *asked, "sweep.trials=4"), asked
        assert made(LR, NETWORK, "sweep.trials=2") == before, asked


@in_a_file
def test_a_study_with_a_running_trial_is_not_widened(started, storage):
    started(LR, NETWORK, "sweep.trials=2")
    claims = TrialClaims(storage.engine, "s")
    assert claims.claim("elsewhere:1:b", 2, 3600.0)
    assert "trial 0 is running" in refused(started, LR, "network=mlp_small,mlp,mlp_deep", "sweep.trials=2")
    claims.release("elsewhere:1:b")
    assert started(LR, "network=mlp_small,mlp,mlp_deep", "sweep.trials=2")


@pytest.mark.parametrize(
    ("url", "killed_in"),
    [
        ("sqlite", "add_trial"),
        ("sqlite", "delete_study"),
        ("sqlite", "copy_study"),
        ("postgresql", "copy_study"),
    ],
    indirect=["url"],
)
def test_whatever_kills_the_process_no_trial_is_lost(made, started, storage, monkeypatch, killed_in):
    before = made(LR, NETWORK, "sweep.trials=3")
    wider = (LR, "network=mlp_small,mlp,mlp_deep", "sweep.trials=3")

    def killed(*args, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(optuna.Study if killed_in == "add_trial" else optuna, killed_in, killed)
        with pytest.raises(KeyboardInterrupt):
            started(*wider)
    assert "s" in optuna.get_all_study_names(storage) or killed_in == "copy_study"
    after = made(*wider)
    assert [(trial.params, trial.values) for trial in after] == [
        (trial.params, trial.values) for trial in before
    ]


@in_a_file
def test_known_settings_are_tried_first_and_once(made):
    asked = (LR, NETWORK, "sweep.enqueue=[{algorithm.lr: 5e-4, network: mlp}, {algorithm.lr: 2e-4}]")
    trials = made(*asked, "sweep.trials=4")
    assert trials[0].params == {"algorithm.lr": 5e-4, "network": "mlp"}
    assert trials[1].params["algorithm.lr"] == 2e-4
    assert trials[2].params["algorithm.lr"] not in (5e-4, 2e-4)
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 4
    more = made(
        *asked[:2],
        "sweep.enqueue=[{algorithm.lr: 5e-4, network: mlp}, {algorithm.lr: 3e-4}]",
        "sweep.trials=5",
    )
    assert [trial.params for trial in more[:4]] == [trial.params for trial in trials]
    assert more[4].params["algorithm.lr"] == 3e-4


@in_a_file
def test_a_run_gives_its_values_of_the_searched_keys(made, trained, tmp_path):
    run = trained("algorithm.lr=4e-4").folder
    (first, *_) = made(LR, NETWORK, f"sweep.enqueue=[{run}]", "sweep.trials=1")
    assert first.params["algorithm.lr"] == 4e-4


@in_a_file
def test_a_study_that_was_deleted_begins_again_with_its_first_trial(made, storage):
    made(LR, "sweep.trials=2")
    optuna.delete_study(study_name="s", storage=storage)
    again = made(LR, "sweep.trials=3")
    assert [(trial.number, trial.state) for trial in again] == [
        (number, TrialState.COMPLETE) for number in range(3)
    ]


@in_a_file
def test_two_workers_that_draw_the_same_together_train_it_with_two_seeds(started, storage, monkeypatch):
    study, worker = started(NETWORK, "sweep.trials=2")
    lease = SimpleNamespace(claim=SimpleNamespace(trial=SimpleNamespace(runs=())), confirm=lambda: None)
    first, second = (
        TrialRun(worker._config, None, lease, study, storage, storage.create_new_trial(study._study_id), None)
        for _ in range(2)
    )
    decided = []

    def suggest(space, trial):
        if trial.number == 0:  # the other worker draws and decides before this one does
            decided.append(second._overrides())
        return ["network=mlp"]

    monkeypatch.setattr(SearchSpace, "suggest", suggest)
    decided.append(first._overrides())
    assert decided == [["network=mlp"], ["network=mlp", "seed=1"]]


@in_a_file
def test_a_setting_that_no_worker_had_begun_runs_once_it_is_begun(started, storage, monkeypatch):
    study, worker = started(LR, "sweep.trials=1")
    look_up = storage.get_trial_id_from_study_id_trial_number

    def enqueued_meanwhile(study_id, number):
        monkeypatch.setattr(storage, "get_trial_id_from_study_id_trial_number", look_up)
        study.enqueue_trial({"algorithm.lr": 2e-4})
        raise KeyError

    monkeypatch.setattr(storage, "get_trial_id_from_study_id_trial_number", enqueued_meanwhile)
    trial_id = worker._trial_id(0)
    assert storage.get_trial(trial_id).state == TrialState.RUNNING


@in_a_file
def test_a_study_keeps_the_options_that_its_glob_found(started):
    study, _ = started("lr_schedule=glob(co*)")
    assert "lr_schedule=choice(constant,cosine)" in study.user_attrs["overrides"]


@in_a_file
def test_a_grid_is_not_widened(started):
    started(NETWORK, "sweep.sampler=grid", "sweep.trials=2")
    message = refused(started, "network=mlp_small,mlp,mlp_deep", "sweep.sampler=grid", "sweep.trials=3")
    assert "sweep.sampler=grid drives the points of the search that it began with" in message


@in_a_file
def test_constants_that_a_run_leaves_as_they_are_are_those_of_its_reward_function(made, trained):
    run, constant = trained().folder, "reward.constants.PROGRESS_WEIGHT"
    written = load_reward_source(StoredRun(run).experiment.reward).constants
    (first,) = made(f"{constant}=interval(0.01,100)", f"sweep.enqueue=[{run}]", "sweep.trials=1")
    assert first.params == {constant: written["PROGRESS_WEIGHT"]}


def test_a_study_that_its_file_names_is_found_again(tmp_path):
    overrides = ["sweep=lr_entropy", "tracking=off", f"runs_dir={tmp_path}"]
    request, storage = compose_sweep(overrides), open_storage(None, tmp_path)
    study = open_study(request, overrides, SearchSpace.from_request(request), None, storage, tmp_path)
    found = with_stored(request, overrides)[2]
    assert found is not None
    assert found.study_name == study.study_name == "lr_entropy"


def test_a_study_resumes_with_another_executor(tmp_path):
    begun = [
        "study=s",
        LR,
        "tracking=off",
        f"runs_dir={tmp_path}",
        "sweep/executor=ray",
        "sweep.executor.address=a:1",
    ]
    request, storage = compose_sweep(begun), open_storage(None, tmp_path)
    open_study(request, begun, SearchSpace.from_request(request), None, storage, tmp_path)
    for more, address in (
        (["sweep/executor=ray", "sweep.executor.address=b:1"], "b:1"),
        (["sweep/executor=local"], None),
    ):
        asked = ["study=s", f"runs_dir={tmp_path}", *more]
        executor = with_stored(compose_sweep(asked), asked)[1].entry.sweep.executor
        assert getattr(executor, "address", None) == address


@in_a_file
def test_a_setting_outside_the_search_is_refused(started):
    for setting, words in {
        "{algorithm.lr: 1.0}": ["algorithm.lr=1.0 is not searched", LR],
        "{network: mlp_deep}": ["network=mlp_deep is not searched", NETWORK],
        "{algorithm.epochs: 3}": ["algorithm.epochs is not searched", "algorithm.lr"],
        "{}": ["none of the keys that are searched"],
        "no_such_run": ["no_such_run"],
    }.items():
        message = refused(started, LR, NETWORK, f"sweep.enqueue=[{setting}]", "sweep.trials=1")
        assert all(word in message for word in words), message
