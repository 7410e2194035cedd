"""The plan of a command that races a stored policy, resolved before PyTorch is imported."""

from dataclasses import dataclass
from pathlib import Path

from deepracer_exp.config.evaluation import EvaluateConfig
from deepracer_exp.config.named import race_of
from deepracer_exp.config.own_class import OF_POLICY
from deepracer_exp.config.parse import import_own_classes
from deepracer_exp.config.stored import EvaluationRequest
from deepracer_exp.env.real_car import require_car
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.tracking.resolve import resolve

from .rival_run import find_rival, kept_rival


@dataclass(frozen=True)
class EvaluatePlan:
    """A stored policy and the protocol of its races."""

    run: StoredRun
    """The run, with its checkpoint."""
    config: EvaluateConfig
    """The request. Unless a protocol was named, it has that by which the training evaluated, with the changes."""
    rival: StoredRun | None = None
    """The run, with its checkpoint, that drives the rival; None: there is none, or it is the policy itself."""


def plan_evaluation(run: str, request: EvaluationRequest, *, has_checkpoint: bool = True) -> EvaluatePlan:
    """Find the run that an evaluation races, and its checkpoint if `has_checkpoint`.

    Raises:
        BadInput: as for `EvaluationRequest.of_run`, `resolve`, `StoredRun.with_policy` and `find_rival`, a rival is
            named for a race without one, or the physical car could not run the policy.
    """
    stored = resolve(run, Path(request.config.runs_dir), request.config.tracking.uri)
    if has_checkpoint:
        stored = stored.with_policy(request.config.checkpoint)
    else:
        import_own_classes(stored.experiment, OF_POLICY)
    config = request.of_run(stored.experiment.evaluation)
    if config.evaluation.real_car is not None:
        require_car(stored.experiment)
    return EvaluatePlan(stored, config, _rival(stored, config))


def _rival(stored: StoredRun, config: EvaluateConfig) -> StoredRun | None:
    experiment, run = stored.experiment, config.rival
    rivals = race_of(experiment, config.evaluation).rivals
    if rivals is None:
        if run is not None:
            raise BadInput(f"rival={run}", "this race has none", "evaluation=head_to_head")
        return None
    if run is not None:
        runs_dir, uri = Path(config.runs_dir), config.tracking.uri
        return find_rival("rival", run, config.rival_checkpoint, experiment, runs_dir, uri)
    return None if config.evaluation.race is not None else kept_rival(experiment, stored.path)
