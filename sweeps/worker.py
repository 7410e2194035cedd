"""A process that makes trial after trial until a study has all of them."""

import logging
import time
import traceback
from collections.abc import Callable
from typing import TypeVar

import optuna
from optuna.trial import TrialState

from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.training.signals import Interruption
from deepracer_exp.training.trainer import TakenOver

from .claims import Claim, Lease, TrialClaims, TrialResult, report_results
from .pruners import build_pruner
from .samplers import build_sampler
from .storage import Storage, patiently
from .trial_run import Interrupted, TrialRun
from .worker_config import WorkerConfig

Value = TypeVar("Value")

_log = logging.getLogger("deepracer_exp")

_WAIT_S = 1.0
"""Between two attempts to claim a trial: another worker's lease may run out."""


class Worker:
    """Claims and makes trials of one study, and reports their results."""

    def __init__(self, config: WorkerConfig, storage: Storage, owner: str):
        """Connect to the study.

        Args:
            config: of the worker.
            storage: where the study is.
            owner: this worker's name.
        """
        self._config, self._storage, self._owner = config, storage, owner
        self._claims = TrialClaims(storage.engine, config.study)
        self._patience_s = config.config.patience_s

    def work(self, interruption: Interruption) -> None:
        """Make trials until all are made or this process is asked to end.

        Raises:
            RunFailed: the database has not answered for too long.
        """
        total, lease_s = self._config.config.trials, self._config.config.lease_s
        while interruption.signum is None:
            self._patiently(lambda: report_results(self._claims, self._storage.optuna))
            claim = self._patiently(lambda: self._claims.claim(self._owner, total, lease_s))
            if claim is not None:
                self._make(claim)
            elif self._patiently(lambda: self._claims.is_done(total)):
                return
            else:
                time.sleep(_WAIT_S)
        self._patiently(lambda: self._claims.release(self._owner))

    def _make(self, claim: Claim) -> None:
        with Lease(self._claims, claim, self._config.config.lease_s, self._patience_s) as lease:
            try:
                result = self._result(lease)
                lease.held(lambda: self._claims.settle(claim, result))
            except TakenOver as error:
                _log.warning("%s", error)
                return
            except Interrupted:
                return
        self._patiently(lambda: report_results(self._claims, self._storage.optuna))

    def _result(self, lease: Lease) -> TrialResult:
        study, trial_id = self._study(), self._trial_id(lease)
        run = self._patiently(
            lambda: TrialRun(self._config, self._claims, lease, study, self._storage.optuna, trial_id)
        )
        try:
            return run.make()
        except BadInput as error:
            # No run was begun: the drawn values do not go together.
            return run.failed(str(error), "")
        except Exception as error:
            if isinstance(error, TakenOver | Interrupted | RunFailed):
                raise
            # A fault of ours ends its trial, with its traceback, and not the other trials.
            return run.failed(f"{type(error).__name__}: {error}", traceback.format_exc())

    def _study(self) -> optuna.Study:
        sampler = build_sampler(self._config.config, self._config.space)
        pruner = build_pruner(self._config.config, self._config.evaluations)
        name, storage = self._config.study, self._storage.optuna
        return self._patiently(
            lambda: optuna.load_study(study_name=name, storage=storage, sampler=sampler, pruner=pruner)
        )

    def _trial_id(self, lease: Lease) -> int:
        """Return the id of the claim's trial in Optuna; create the trial if there is none.

        A trial that is created and not recorded, because its worker is killed in between, is failed at the end of the
        sweep: Optuna is never asked which trials there are.
        """
        if lease.claim.trial_id is not None:
            return lease.claim.trial_id
        lease.confirm()
        storage, index = self._storage.optuna, lease.claim.index
        template = optuna.trial.create_trial(state=TrialState.RUNNING, user_attrs={"slot": index})
        trial_id = self._patiently(
            lambda: storage.create_new_trial(storage.get_study_id_from_name(self._config.study), template)
        )
        lease.held(lambda: self._claims.record(lease.claim, trial_id=trial_id))
        return trial_id

    def _patiently(self, call: Callable[[], Value]) -> Value:
        return patiently(call, self._patience_s)
