"""A worker: makes trial after trial until a study has all of them."""

import contextlib
import logging
import time
import traceback
from collections.abc import Callable
from typing import TypeVar

import optuna
from optuna.storages import RDBStorage
from optuna.trial import TrialState

from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.sweeps.search.pruners import build_pruner
from deepracer_exp.sweeps.search.samplers import build_sampler
from deepracer_exp.sweeps.trial import Interrupted, Trial
from deepracer_exp.tracking.projector import Projector
from deepracer_exp.training.signals import Interruption
from deepracer_exp.training.train_result import TakenOver

from .claims import Claim, TrialClaims, report_results
from .lease import Lease
from .storage import patiently, resolve_database
from .trial_run import TrialRun
from .worker_config import WorkerConfig

Value = TypeVar("Value")

_log = logging.getLogger("deepracer_exp")

_WAIT_S = 1.0
"""Between two attempts to claim a trial: another worker's lease may run out."""


class Worker:
    """Claims and makes trials of one study, and reports their results."""

    def __init__(self, config: WorkerConfig, storage: RDBStorage, owner: str, projector: Projector):
        """Connect to the study; `owner` is this worker's name, and `projector` records its runs."""
        self._config, self._storage, self._owner = config, storage, owner
        self._projector = projector
        self._claims = TrialClaims(storage.engine, config.study)
        self._cached = optuna.storages.get_storage(storage)
        """The storage, which reads the trials that have ended only once in this process."""
        self._database = resolve_database(config.config.storage, config.runs_dir)
        self._patience_s = config.config.patience_s

    def work(self, interruption: Interruption) -> None:
        """Make trials until all are made or this process is asked to end.

        Raises:
            RunFailed: the database has not answered for too long.
        """
        total, lease_s = self._config.config.trials, self._config.config.lease_s
        self._report()
        while interruption.signum is None:
            claim = self._patiently(lambda: self._claims.claim(self._owner, total, lease_s))
            if claim is not None:
                self._make(claim)
            elif self._patiently(lambda: self._claims.is_done(total)):
                return
            else:
                time.sleep(_WAIT_S)
            self._report()
        self._patiently(lambda: self._claims.release(self._owner))

    def _make(self, claim: Claim) -> None:
        lease_s = self._config.config.lease_s
        with Lease(self._claims, claim, lease_s, self._patience_s) as lease:
            try:
                ended = self._ended(lease)
                lease.held(lambda: self._claims.settle(claim, ended))
            except TakenOver as error:
                _log.warning("%s", error)
            except Interrupted:
                pass

    def _report(self) -> None:
        """Report results to Optuna, those of workers that are gone as well."""
        self._patiently(lambda: report_results(self._claims, self._storage))

    def _ended(self, lease: Lease) -> Trial:
        sampler = build_sampler(self._config.config, self._config.space)
        pruner = build_pruner(self._config.config, self._config.evaluations)
        name, storage = self._config.study, self._cached
        study = self._patiently(
            lambda: optuna.load_study(study_name=name, storage=storage, sampler=sampler, pruner=pruner)
        )
        lease.confirm()
        trial_id = self._patiently(lambda: self._trial_id(lease.claim.trial.number))
        run = self._patiently(
            lambda: TrialRun(
                self._config, self._claims, lease, study, self._storage, trial_id, self._projector
            )
        )
        try:
            return run.make()
        except BadInput as error:
            # No run was begun: the drawn values do not go together.
            return run.failed(str(error), "")
        except Exception as error:
            if isinstance(error, TakenOver | Interrupted | RunFailed):
                raise
            # A bug of ours ends this trial, with its traceback, and not the others.
            return run.failed(f"{type(error).__name__}: {error}", traceback.format_exc())

    def _trial_id(self, number: int) -> int:
        """Return Optuna's id of a trial; create the trials up to it that do not exist.

        A worker that is killed before it creates its trial leaves no gap, so that a trial has the same number here and
        in Optuna: the next worker creates both.
        """
        storage = self._storage
        study_id = storage.get_study_id_from_name(self._config.study)

        def begun() -> int:
            trial_id = storage.get_trial_id_from_study_id_trial_number(study_id, number)
            if storage.get_trial(trial_id).state == TrialState.WAITING:  # enqueued
                storage.set_trial_state_values(trial_id, TrialState.RUNNING)
            return trial_id

        with contextlib.suppress(KeyError):
            return begun()
        with self._database.creation_lock(storage.engine):
            with contextlib.suppress(KeyError):
                return begun()
            created = storage.create_new_trial(study_id)
            while storage.get_trial_number_from_id(created) < number:
                created = storage.create_new_trial(study_id)
            return created

    def _patiently(self, call: Callable[[], Value]) -> Value:
        return patiently(call, self._patience_s)
