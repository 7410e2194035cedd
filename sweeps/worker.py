"""A process that makes trial after trial until a study has all of them."""

import logging
import time
import traceback
from collections.abc import Callable
from typing import TypeVar

import optuna
from optuna.storages import BaseStorage
from optuna.trial import TrialState

from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.training.signals import Interruption
from deepracer_exp.training.watching import TakenOver

from .lease import Lease
from .ledger import Claim, Ledger
from .plan import Plan
from .pruners import build_pruner
from .samplers import build_sampler
from .storage import Storage, patiently
from .telling import tell_settled
from .trial_run import Interrupted, Result, TrialRun

Value = TypeVar("Value")

_log = logging.getLogger("deepracer_exp")

_WAIT_S = 1.0
"""Between two looks for something to do: a lease of somebody else may run out."""


class Worker:
    """Claims, makes and tells trials of one study."""

    def __init__(self, plan: Plan, storage: Storage, owner: str):
        """Load the study.

        Args:
            plan: of the sweep.
            storage: where it is.
            owner: this worker's name.
        """
        self._plan, self._storage, self._owner = plan, storage, owner
        self._ledger = Ledger(storage.engine, plan.study)
        self._patience_s = plan.config.patience_s

    def work(self, interruption: Interruption) -> None:
        """Make trials until all are made, or this process is told to end.

        Raises:
            RunFailed: the database has not answered for too long.
        """
        plan, total = self._plan, self._plan.config.trials
        while interruption.signum is None:
            self._patiently(lambda: tell_settled(plan.study, self._ledger, self._storage.optuna))
            claim = self._patiently(lambda: self._ledger.claim(self._owner, total, plan.config.lease_s))
            if claim is not None:
                self._make(claim)
            elif self._patiently(lambda: self._ledger.is_done(total)):
                return
            else:
                time.sleep(_WAIT_S)
        self._patiently(lambda: self._ledger.release(self._owner))

    def _make(self, claim: Claim) -> None:
        with Lease(self._ledger, claim, self._plan.config.lease_s, self._patience_s) as lease:
            try:
                result = self._result(lease)
                lease.held(lambda: self._ledger.settle(claim, result.outcome, result.values, result.attrs))
            except TakenOver as error:
                _log.warning("%s", error)
                return
            except Interrupted:
                return
        self._patiently(lambda: tell_settled(self._plan.study, self._ledger, self._storage.optuna))

    def _result(self, lease: Lease) -> Result:
        study, trial_id = self._study(), self._trial_id(lease)
        run = self._patiently(
            lambda: TrialRun(self._plan, self._ledger, lease, study, self._storage.optuna, trial_id)
        )
        try:
            return run.make()
        except BadInput as error:
            # No run was begun: what was drawn does not go together.
            return run.failed(str(error), "")
        except Exception as error:
            if isinstance(error, TakenOver | Interrupted | RunFailed):
                raise
            # A fault of ours ends its trial, with its traceback, and not the other trials.
            return run.failed(f"{type(error).__name__}: {error}", traceback.format_exc())

    def _study(self) -> optuna.Study:
        config = self._plan.config
        sampler, pruner = (
            build_sampler(config, self._plan.space),
            build_pruner(config, self._plan.evaluations),
        )
        name, storage = self._plan.study, self._storage.optuna
        return self._patiently(
            lambda: optuna.load_study(study_name=name, storage=storage, sampler=sampler, pruner=pruner)
        )

    def _trial_id(self, lease: Lease) -> int:
        """Return Optuna's trial of the claim; make it if there is none."""
        if lease.claim.trial_id is not None:
            return lease.claim.trial_id
        lease.confirm()
        trial_id = self._patiently(
            lambda: _trial_of(self._plan.study, self._storage.optuna, lease.claim.slot)
        )
        lease.held(lambda: self._ledger.note(lease.claim, trial_id=trial_id))
        return trial_id

    def _patiently(self, call: Callable[[], Value]) -> Value:
        return patiently(call, self._patience_s)


def _trial_of(study: str, storage: BaseStorage, slot: int) -> int:
    study_id = storage.get_study_id_from_name(study)
    running = storage.get_all_trials(study_id, deepcopy=False, states=(TrialState.RUNNING,))
    for trial in running:  # its worker was killed before it could note it
        if trial.user_attrs.get("slot") == slot:
            return trial._trial_id
    template = optuna.trial.create_trial(state=TrialState.RUNNING, user_attrs={"slot": slot})
    return storage.create_new_trial(study_id, template)
