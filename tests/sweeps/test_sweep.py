"""Parts of a sweep: its stopping rules, its parent, its run in MLflow, and its end."""

import shutil
import signal
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import optuna
import pytest
from mlflow import MlflowClient

from deepracer_exp.config.compose import compose_evaluation, compose_experiment
from deepracer_exp.config.sweep import compose_sweep
from deepracer_exp.errors import RunFailed
from deepracer_exp.evaluation.race_protocol import Attempt
from deepracer_exp.evaluation.results import HELD_OUT, USUAL, Evaluation, TrialGroup
from deepracer_exp.runs.run_files import read_object
from deepracer_exp.sweeps.fresh_laps import interval_of, rerank
from deepracer_exp.sweeps.queue.claims import Claim
from deepracer_exp.sweeps.queue.driver import Driver
from deepracer_exp.sweeps.queue.storage import open_storage
from deepracer_exp.sweeps.queue.worker_config import Parent
from deepracer_exp.sweeps.run_sweep import _conclude, _parent, _without_rules, begin_study_run
from deepracer_exp.sweeps.search.objectives import objective_values
from deepracer_exp.sweeps.search.space import SearchSpace
from deepracer_exp.sweeps.trial import Interrupted, SeedRun, Trial
from deepracer_exp.tracking import study_run
from deepracer_exp.tracking.store import resolve_store
from deepracer_exp.training.signals import Interruption
from tests.tracking.conftest import ProjectorHere

from .studies import add, new_study

LR = "algorithm.lr=tag(log,interval(1e-5,1e-3))"
MEDIAN = "sweep.pruners=[median]"


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["study=s", LR], []),
        (["study=s", LR, MEDIAN], ["stopping=none"]),
        (["study=s", LR, MEDIAN, "stopping=plateau"], ["stopping=plateau"]),
        (["study=s", LR, MEDIAN, "stopping=entropy,none"], []),
        (["sweep=lr_entropy"], ["stopping=impatient"]),
        (["sweep=lr_entropy", MEDIAN], ["stopping=none"]),
        (["sweep=lr_entropy", MEDIAN, "stopping=impatient"], ["stopping=impatient"]),
        (
            ["sweep=lr_entropy", "stopping.converged.patience=50"],
            ["stopping=impatient", "stopping.converged.patience=50"],
        ),
        # A file that chooses rule and pruners keeps both.
        (["sweep=mine"], ["stopping=plateau"]),
    ],
)
def test_trials_have_a_stopping_rule_if_the_pruner_entropy_or_a_rule_is_asked_for(
    tmp_path, monkeypatch, overrides, expected
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf/sweep").mkdir(parents=True)
    (tmp_path / "conf/sweep/mine.yaml").write_text(
        "defaults: [own, _self_]\ntrain: [stopping=plateau]\npruners: [median]\nspace: {algorithm.lr: '0.1,0.2'}\n"
    )
    base = _without_rules(compose_sweep(overrides), overrides).base
    assert [line for line in base if line.startswith("stopping")] == expected


def test_impatient_is_entropy_that_decides_sooner_that_a_run_has_converged():
    patient, impatient = (
        compose_experiment([f"stopping={one}"])[0].stopping for one in ("entropy", "impatient")
    )
    assert impatient.converged.warmup < patient.converged.warmup
    sooner = {key: getattr(impatient.converged, key) for key in ("warmup", "patience", "best_patience")}
    assert impatient == replace(patient, converged=replace(patient.converged, **sooner))


def test_the_parent_is_resolved_when_a_study_is_begun_and_stays_the_same(trained):
    folder = trained().folder
    runs_dir = folder.parents[1]
    request = compose_sweep(["study=p", "parent=best:tiny", f"runs_dir={runs_dir}", LR])
    best = read_object(folder / "summary.json")["best"]["iteration"]
    found = _parent(request, None)
    assert found == Parent(str(folder.resolve()), best)
    # Something better, trained since, changes nothing for a study that has begun.
    begun = SimpleNamespace(
        user_attrs={"parent": "best:tiny", "parent_run": {"run_dir": "/a", "checkpoint": 3}}
    )
    assert _parent(request, begun) == Parent("/a", 3)
    asks_for_another = SimpleNamespace(user_attrs=begun.user_attrs | {"parent": "best:other"})
    assert _parent(request, asks_for_another) == found
    assert _parent(compose_sweep(["study=p", LR]), None) is None


def test_drivers_that_begin_at_once_share_one_run_in_mlflow(monkeypatch, tmp_path, empty_database):
    shutil.copy(empty_database, tmp_path / "mlflow.db")
    monkeypatch.setattr(study_run, "Projector", ProjectorHere)
    request = compose_sweep(["study=spring", LR])
    space, store = SearchSpace.from_request(request), resolve_store(None, tmp_path)

    def begin(_):
        return begin_study_run(request, space, store, tmp_path)

    with ThreadPoolExecutor(3) as drivers:
        begun = list(drivers.map(begin, range(3)))
    assert all(run.finish("FINISHED", 60) for run, _ in begun)
    client = MlflowClient(tracking_uri=store.uri)
    (found,) = client.search_runs([client.get_experiment_by_name("spring").experiment_id])
    assert {run_id for _, run_id in begun} == {found.info.run_id}


def test_ctrl_c_ends_the_re_ranking_between_two_trials(tmp_path):
    study = new_study(tmp_path)
    add(study, [9.0], metrics=1)
    config = SimpleNamespace(rerank=1, rerank_laps=60, clone=None, objectives=("race_score",))
    protocol = compose_evaluation(["evaluation=sweep"])[0].evaluation
    worker_config = SimpleNamespace(config=config, protocol=protocol, folder=tmp_path, runs_dir=tmp_path)
    interruption = Interruption()
    interruption.signum = signal.SIGINT
    with pytest.raises(Interrupted):
        _conclude(worker_config, study, SimpleNamespace(), SimpleNamespace(), interruption, False)
    assert "reranked" not in study.user_attrs


def _lap(trial: int, time_s: float, progress: float = 100.0) -> Attempt:
    end = "lap_complete" if progress == 100.0 else "off_track"
    never = {"begin_s": 0.0, "penalty_s": 0.0, "resets": 0}
    return Attempt(trial=trial, time_s=time_s, progress=progress, end=end, **never)


def test_the_interval_of_a_race_score_holds_the_score_of_all_conditions():
    usual = [_lap(trial, 6.0) for trial in range(20)]
    held_out = [_lap(trial, 8.0) if trial % 2 else _lap(trial, 4.0, 50.0) for trial in range(20, 40)]
    groups = ((USUAL, range(20), usual), (HELD_OUT, range(20, 40), held_out))
    evaluation = Evaluation(
        tuple(TrialGroup("road", where, tuple(trials), tuple(laps)) for where, trials, laps in groups)
    )
    assert evaluation.race_score_s == pytest.approx(8.0)
    low, high = interval_of([evaluation], "race_score", 120.0)
    assert 7.0 < low < 8.0 < high < 9.0
    assert interval_of([evaluation], "lap_time", 120.0) == pytest.approx([6.0, 6.0])
    assert interval_of([evaluation], "completion", 120.0) == pytest.approx([100.0, 100.0])


def test_a_lap_time_needs_a_lap_on_every_track():
    def on(track: str, progress: float, time_s: float, first: int) -> TrialGroup:
        trials = range(first, first + 10)
        return TrialGroup(track, USUAL, tuple(trials), tuple(_lap(k, time_s, progress) for k in trials))

    both = Evaluation((on("short", 100.0, 8.0, 0), on("long", 100.0, 20.0, 10)))
    one = Evaluation((on("short", 100.0, 8.0, 0), on("long", 60.0, 12.0, 10)))
    for evaluation, lap_s in ((both, 14.0), (one, 120.0 * 1.2)):
        assert objective_values(evaluation, ["lap_time"], 120.0) == pytest.approx([lap_s])
        for objective in ("lap_time", "race_score"):
            assert interval_of([evaluation], objective, 120.0) == pytest.approx([lap_s, lap_s])
    assert interval_of([one], "completion", 120.0) == pytest.approx([80.0, 80.0])


def test_a_trial_whose_run_was_deleted_is_not_driven_again(tmp_path):
    study = new_study(tmp_path)
    add(study, [9.0])
    add(study, [10.0], metrics=1)
    config = SimpleNamespace(rerank=2, rerank_laps=60)
    protocol = compose_evaluation(["evaluation=sweep"])[0].evaluation
    driven: list[int] = []

    def on_next(trial: optuna.trial.FrozenTrial) -> None:
        driven.append(trial.number)
        raise Interrupted

    with pytest.raises(Interrupted):
        rerank(SimpleNamespace(config=config, protocol=protocol, folder=tmp_path), study, on_next, print)
    assert driven == [1]


def test_the_same_error_of_several_runs_is_counted_as_one(tmp_path):
    def failed(number: int) -> Claim:
        file = tmp_path.resolve() / f"20261122-12000{number}-seed0" / "metrics.jsonl"
        runs = (SeedRun(seed=0, reason=f"{file}: cannot be read"),)
        trial = Trial(number=number, state="FAIL", runs=runs)
        return Claim(trial=trial, attempt=1, owner="a", is_reported=True, progress={}, expired=False)

    config = SimpleNamespace(config=SimpleNamespace(trials=9), folder=tmp_path, study="s")
    driver = Driver(
        config, open_storage(None, tmp_path), SimpleNamespace(workers=1), SimpleNamespace(), print
    )
    words = r"all 3 trials so far failed, 3 of them with: RUN/metrics.jsonl: cannot"
    with pytest.raises(RunFailed, match=words) as refused:
        driver._give_up_if_all_fail([failed(number) for number in range(3)])
    assert "\n" not in str(refused.value)
    # Started again: the cause may be mended.
    driver._ended_before = frozenset(range(3))
    driver._give_up_if_all_fail([failed(number) for number in range(5)])
    with pytest.raises(RunFailed, match="all 3 trials so far failed"):
        driver._give_up_if_all_fail([failed(number) for number in range(6)])
