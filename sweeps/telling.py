"""Optuna told of what the ledger knows."""

import optuna
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, TrialState

from .ledger import Ledger


def tell_settled(study: str, ledger: Ledger, storage: BaseStorage) -> None:
    """Tell Optuna of the trials that the ledger has results of: a worker may have been killed in between."""
    for slot in ledger.settled():
        assert slot.trial_id is not None
        assert slot.outcome is not None
        try:
            for key, value in slot.attrs.items():
                storage.set_trial_user_attr(slot.trial_id, key, value)
            # Not by `Study.tell`, which ends the process's study with the last point of a grid.
            state = TrialState[slot.outcome]
            values = slot.values if state != TrialState.PRUNED else _last(storage.get_trial(slot.trial_id))
            storage.set_trial_state_values(slot.trial_id, state, values)
        except optuna.exceptions.UpdateFinishedTrialError:
            pass  # somebody else was faster, with the same
        ledger.mark_told(slot.slot)


def tell_strays(study: str, ledger: Ledger, storage: BaseStorage) -> None:
    """End Optuna's trials that belong to no slot: their workers were killed or too late just when they made them."""
    known = {slot.trial_id for slot in ledger.slots()}
    study_id = storage.get_study_id_from_name(study)
    for trial in storage.get_all_trials(study_id, deepcopy=False, states=(TrialState.RUNNING,)):
        if trial._trial_id not in known:
            storage.set_trial_user_attr(trial._trial_id, "fate", "failed")
            storage.set_trial_user_attr(trial._trial_id, "reason", "its worker was lost before it began")
            storage.set_trial_state_values(trial._trial_id, TrialState.FAIL)


def _last(trial: FrozenTrial) -> list[float] | None:
    """Return what a pruned trial was worth in the end, as `Study.tell` records it."""
    return None if trial.last_step is None else [trial.intermediate_values[trial.last_step]]
