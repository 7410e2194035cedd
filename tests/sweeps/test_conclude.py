"""The end of a sweep, once all trials are made."""

import signal
from types import SimpleNamespace

import pytest

from deepracer_exp.config.compose import compose_evaluation
from deepracer_exp.errors import RunFailed
from deepracer_exp.evaluation.race_protocol import Attempt
from deepracer_exp.evaluation.result import HELD_OUT, USUAL, Evaluation, Group
from deepracer_exp.training.signals import Interruption
from sweeps.driver import Driver
from sweeps.storage import open_storage
from sweeps.sweep import _conclude, interval_of
from sweeps.worker import Interrupted

from .studies import add, new_study


def test_ctrl_c_ends_the_re_ranking_between_two_trials(tmp_path):
    study = new_study(tmp_path)
    add(study, [9.0])
    config = SimpleNamespace(rerank=1, rerank_laps=60, objectives=("race_score",))
    protocol = compose_evaluation(["run=any", "evaluation=sweep"])[0].evaluation
    worker_config = SimpleNamespace(config=config, protocol=protocol, folder=tmp_path, runs_dir=tmp_path)
    interruption = Interruption()
    interruption.signum = signal.SIGINT
    with pytest.raises(Interrupted):
        _conclude(worker_config, study, SimpleNamespace(), SimpleNamespace(), interruption)
    assert "reranked" not in study.user_attrs


def _lap(trial: int, time_s: float, progress: float = 100.0) -> Attempt:
    end = "lap_complete" if progress == 100.0 else "off_track"
    return Attempt(
        trial=trial, begin_s=0.0, time_s=time_s, penalty_s=0.0, resets=0, progress=progress, end=end
    )


def test_the_interval_of_a_race_score_holds_the_score_of_all_conditions():
    usual = [_lap(trial, 6.0) for trial in range(20)]
    held_out = [_lap(trial, 8.0) if trial % 2 else _lap(trial, 4.0, 50.0) for trial in range(20, 40)]
    evaluation = Evaluation(
        (
            Group("road", USUAL, tuple(range(20)), tuple(usual)),
            Group("road", HELD_OUT, tuple(range(20, 40)), tuple(held_out)),
        )
    )
    assert evaluation.race_score_s == pytest.approx(8.0)
    low, high = interval_of([evaluation], "race_score", 120.0)
    assert 7.0 < low < 8.0 < high < 9.0
    assert interval_of([evaluation], "lap_time", 120.0) == pytest.approx([6.0, 6.0])
    assert interval_of([evaluation], "completion", 120.0) == pytest.approx([100.0, 100.0])


def test_the_same_error_of_several_runs_is_counted_as_one(tmp_path):
    def failed(number: int) -> SimpleNamespace:
        file = tmp_path.resolve() / f"20261122-12000{number}-seed0" / "metrics.jsonl"
        return SimpleNamespace(
            result=SimpleNamespace(state="FAIL", attrs={"reason": f"{file}: cannot be read"})
        )

    worker_config = SimpleNamespace(config=SimpleNamespace(trials=9), folder=tmp_path, study="s")
    driver = Driver(
        worker_config, open_storage(None, tmp_path), SimpleNamespace(workers=1), SimpleNamespace(), print
    )
    with pytest.raises(
        RunFailed, match=r"all 3 trials so far failed, 3 of them with: RUN/metrics.jsonl: cannot"
    ) as refused:
        driver._give_up_if_all_fail([failed(number) for number in range(3)])
    assert "\n" not in str(refused.value)
