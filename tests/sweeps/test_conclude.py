"""The end of a sweep, once all trials are made."""

import signal
from types import SimpleNamespace

import pytest

from deepracer_exp.config.compose import compose_evaluation
from deepracer_exp.errors import RunFailed
from deepracer_exp.training.signals import Interruption
from sweeps.driver import Driver
from sweeps.storage import open_storage
from sweeps.sweep import _conclude
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
