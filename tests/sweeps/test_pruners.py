"""Pruners that compare trials, and the comparison of seeds."""

from collections.abc import Sequence

import optuna
import pytest
from optuna.trial import TrialState, create_trial

from deepracer_exp.config.sweep import SweepConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.sweeps.search.pruners import FirstOf, PruneDecision, build_pruner

from . import studies

pytestmark = pytest.mark.filterwarnings("error")


def settings(*pruners: str, **changes) -> SweepConfig:
    return studies.settings(pruners=pruners, **{"warmup_evaluations": 1, **changes})


def study_of(curves: Sequence[Sequence[float]], direction: str = "minimize") -> optuna.Study:
    """Return a study of complete trials with these scores at evaluations 1, 2, ..."""
    study = optuna.create_study(direction=direction, study_name="pruned")
    for curve in curves:
        steps = dict(enumerate(curve, 1))
        study.add_trial(create_trial(value=curve[-1], intermediate_values=steps))
    return study


def pruned_at(
    study: optuna.Study, pruner: FirstOf, curve: Sequence[float]
) -> tuple[int, PruneDecision] | None:
    """Return the evaluation after which a new trial is pruned, and why."""
    trial = study.ask()
    for step, score in enumerate(curve, 1):
        trial.report(score, step)
        decision = pruner.decide(study, study.trials[trial.number])
        if decision is not None:
            study.tell(trial, state=TrialState.PRUNED)
            return step, decision
    study.tell(trial, curve[-1])
    return None


SIX = [[90 - level - 5 * step for step in range(6)] for level in range(0, 30, 5)]
"""Scores in seconds of six trials, all getting better; 52.5 is their median at the fourth evaluation."""


@pytest.mark.parametrize(
    ("name", "curve", "reason"),
    [
        ("median", [99, 98, 97, 96], "98 at evaluation 2 is not in the better half"),
        ("median", [64, 59, 54, 49], None),
        ("median", SIX[3], None),
        ("percentile", SIX[3], "70 at evaluation 2 is not in the best 25%"),
    ],
)
def test_the_worse_ones_of_the_same_evaluation_are_pruned_after_the_warmup(name, curve, reason):
    expected = None if reason is None else (2, (name, reason))
    assert pruned_at(study_of(SIX), build_pruner(settings(name)), curve) == expected


def test_no_trial_is_compared_before_the_startup_trials_are_complete():
    assert pruned_at(study_of(SIX[:3]), build_pruner(settings("median")), [99, 98, 97, 96]) is None


def test_low_values_of_an_objective_to_maximize_are_pruned():
    study = study_of([[-score for score in curve] for curve in SIX], "maximize")
    pruner = build_pruner(settings("median", objectives=("completion",)))
    assert pruned_at(study, pruner, [-99, -98]) is not None
    assert pruned_at(study, pruner, [-64, -59]) is None


def test_hyperband_prunes_losers_of_a_rung():
    study = study_of([])
    pruner = build_pruner(settings("hyperband", warmup_evaluations=0), evaluations=9)
    ends = [pruned_at(study, pruner, [50 - number + step for step in range(9)]) for number in range(12)]
    assert all(end is None for end in ends)  # each is the best so far
    ends = [pruned_at(study, pruner, [90 + number + step for step in range(9)]) for number in range(12)]
    assert {step for step, _ in ends} <= {1, 3, 9}
    assert {decision.name for _, decision in ends} == {"hyperband"}
    assert ends[0][1].reason.endswith("is not in the best third")


def test_a_patient_pruner_waits_while_a_trial_improves():
    better, stuck = [99, 98, 97, 96, 95, 94], [95, 95, 99, 99, 99, 99]
    for name in ("median", "percentile", "hyperband"):
        study, own = study_of(SIX), {"warmup_evaluations": 0}
        patient = build_pruner(settings(name, **own, patience=2), evaluations=6)
        assert pruned_at(study, patient, better) is None
        if name != "hyperband":  # it looks at its rungs only
            assert pruned_at(study, build_pruner(settings(name, **own)), better)[0] == 1
            assert pruned_at(study, patient, stuck)[0] == 5


@pytest.mark.parametrize("pruners", [(), ("entropy",)])
def test_pruners_that_compare_no_evaluations_let_every_trial_continue(pruners):
    assert pruned_at(study_of(SIX), build_pruner(settings(*pruners)), [99, 99, 99]) is None


def test_pruners_that_compare_one_score_are_refused_with_several_objectives():
    objectives = ("lap_time", "completion")
    refusal = r"^sweep\.pruners=\[entropy,median\]: median .*\[lap_time,completion\]; accepted .*\[entropy\]"
    with pytest.raises(BadInput, match=refusal):
        build_pruner(settings("entropy", "median", objectives=objectives))
    build_pruner(settings("entropy", objectives=objectives))
