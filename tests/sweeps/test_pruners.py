import functools
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import optuna
import pytest
import yaml
from optuna.trial import TrialState, create_trial

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.sweep import SweepConfig, compose_sweep
from deepracer_exp.errors import BadInput
from sweeps.pruners import AnyPruner, build_pruner, is_worse_across_seeds

ACTIONS = 15
pytestmark = pytest.mark.filterwarnings("error")


def settings(*pruners: str, **changes) -> SweepConfig:
    given = {"pruners": pruners, "startup_trials": 4, "warmup_evaluations": 1, "patience": None}
    return replace(standard(), **{**given, **changes})


@functools.cache
def standard() -> SweepConfig:
    return compose_sweep([]).entry.sweep


@functools.cache
def config_of(*overrides: str) -> str:
    values = compose_experiment(list(overrides))[1].mapping
    return yaml.safe_dump(json.loads(json.dumps(values)))


def rows(length: int, entropy: Callable[[int], float], completion: Callable[[int], float]) -> list[dict]:
    """Rows of metrics.jsonl; entropy as a share of chance."""
    return [
        {
            "iteration": number,
            "env_steps": 8192 * number,
            "wall_clock_s": 0.5 * number,
            "laps": 5 * number if completion(number) > 90 else 0,
            "completion": completion(number),
            "mean_return": completion(number),
            "entropy": entropy(number) * math.log(ACTIONS),
        }
        for number in range(1, length + 1)
    ]


def collapsed(length: int = 60) -> list[dict]:
    return rows(length, lambda i: max(0.01, 1 - 0.1 * i), lambda i: 20.0)


def converged(length: int = 300) -> list[dict]:
    return rows(length, lambda i: max(0.01, 1 - 0.02 * i), lambda i: min(98.0, 2.0 * i))


def idle(length: int = 60) -> list[dict]:
    return rows(length, lambda i: 0.999, lambda i: 11.0)


@pytest.fixture
def run(tmp_path) -> "Run":
    return Run(tmp_path / "run")


class Run:
    """A run folder that grows, and the trial that it belongs to."""

    def __init__(self, path: Path):
        self.path = path
        self.study = optuna.create_study()
        self._trial = self.study.ask()
        self._trial.set_user_attr("run_dir", str(path))

    def begin(self, *overrides: str) -> "Run":
        self.path.mkdir()
        (self.path / "config.yaml").write_text(config_of(*overrides), encoding="utf-8")
        return self

    def write(self, found: Sequence[dict], rest: str = "") -> "Run":
        text = "".join(json.dumps(row) + "\n" for row in found) + rest
        (self.path / "metrics.jsonl").write_text(text, encoding="utf-8")
        return self

    def decision(self, pruner: AnyPruner) -> tuple[str, str] | None:
        trial = self.study.trials[0]
        decision = pruner.decide(self.study, trial)
        assert pruner.prune(self.study, trial) == (decision is not None)
        return decision


@pytest.fixture
def entropy() -> AnyPruner:
    return build_pruner(settings("entropy"))


def test_a_collapsed_run_is_pruned_with_its_reason_in_one_line(run, entropy):
    name, reason = run.begin().write(collapsed()).decision(entropy)
    assert name == "collapsed"
    assert re.fullmatch(r"entropy at [1-4]\.\d% with 20 % completion", reason)


def test_a_run_that_stays_as_it_began_is_pruned_as_not_learning(run, entropy):
    name, reason = run.begin().write(idle()).decision(entropy)
    assert name == "not_learning"
    assert "\n" not in reason


def test_a_run_is_pruned_at_the_same_row_whether_it_is_read_row_by_row_or_at_once(run, entropy):
    found = collapsed()
    run.begin()
    at_once = [run.write(found[:n]).decision(build_pruner(settings("entropy"))) for n in range(25, 33)]
    row_by_row = [run.write(found[:n]).decision(entropy) for n in range(25, 33)]
    assert at_once[0] is None
    # What was said at first stays, though later rows say it with other numbers.
    first = at_once.index(next(filter(None, at_once)))
    assert row_by_row == [*at_once[:first], *[at_once[first]] * (8 - first)]
    assert None not in at_once[first:]


def test_a_converged_run_is_never_pruned_even_if_it_falls_apart_later(run, entropy):
    found = converged()
    worse = [row | {"iteration": 300 + row["iteration"]} for row in collapsed(200)]
    run.begin("stopping=none")
    for length in range(0, 300, 7):
        assert run.write(found[:length]).decision(entropy) is None
    assert run.write([*found, *worse]).decision(entropy) is None


@pytest.mark.parametrize("option", ["none", "reliable", "plateau"])
def test_a_run_with_another_stopping_rule_is_judged_by_the_standard_one(run, entropy, option):
    assert run.begin(f"stopping={option}").write(collapsed()).decision(entropy).name == "collapsed"


def test_a_run_is_judged_by_its_own_thresholds(run, entropy):
    assert run.begin("stopping.collapsed=null").write(collapsed()).decision(entropy) is None


def test_a_continuous_policy_is_judged_by_its_scatter_since_the_start(run, entropy):
    found = [row | {"entropy": 2.0 - 0.2 * row["iteration"]} for row in collapsed()]
    assert run.begin("action_space=continuous").write(found).decision(entropy).name == "collapsed"


def test_a_trial_continues_before_it_has_a_run_its_folder_its_files_or_a_row(run, entropy):
    study = optuna.create_study()
    study.ask()
    assert entropy.decide(study, study.trials[0]) is None
    assert run.decision(entropy) is None
    run.path.mkdir()
    assert run.decision(entropy) is None
    run.path.rmdir()
    run.begin()
    assert run.decision(entropy) is None
    assert run.write([]).decision(entropy) is None
    assert run.write([], rest='{"itera').decision(entropy) is None


def test_a_half_written_last_line_is_left_for_the_next_look(run, entropy):
    found = collapsed()
    run.begin()
    for row in range(40):
        text = json.dumps(found[row])
        for cut in (0, 1, len(text) // 2, len(text)):
            run.write(found[:row], rest=text[:cut]).decision(entropy)
    assert run.decision(entropy).name == "collapsed"


def test_a_run_that_was_resumed_from_an_earlier_row_is_read_again(run, entropy):
    begun = converged(48)
    # Its checkpoint was of row 30; this time the run continues badly.
    bad = rows(60, lambda i: 0.01, lambda i: 20.0)[30:]
    run.begin()
    assert run.write(begun).decision(entropy) is None
    assert run.write([*begun[:30], *bad]).decision(entropy).name == "collapsed"


def test_a_run_copied_elsewhere_is_read_there(run, entropy, tmp_path):
    assert run.begin().write(converged(50)).decision(entropy) is None
    again = Run(tmp_path / "again").begin().write(collapsed())
    run._trial.set_user_attr("run_dir", str(again.path))
    assert run.decision(entropy).name == "collapsed"


def test_rows_that_no_training_wrote_are_reported_with_file_and_line(run, entropy):
    run.begin().write([], rest="{}\nno row\n{}\n")
    with pytest.raises(BadInput, match=r"metrics\.jsonl line 2: is not valid JSON"):
        run.decision(entropy)


def study_of(curves: Sequence[Sequence[float]], direction: str = "minimize") -> optuna.Study:
    """Return a study of complete trials with these scores at evaluations 1, 2, ..."""
    study = optuna.create_study(direction=direction, study_name="pruned")
    for curve in curves:
        steps = dict(enumerate(curve, 1))
        study.add_trial(create_trial(value=curve[-1], intermediate_values=steps))
    return study


def pruned_at(
    study: optuna.Study, pruner: AnyPruner, curve: Sequence[float]
) -> tuple[int, tuple[str, str]] | None:
    """Return the evaluation after which a new trial is pruned, and why."""
    trial = study.ask()
    for step, score in enumerate(curve, 1):
        trial.report(score, step)
        decision = pruner.decide(study, study.trials[trial.number])
        if decision is not None:
            assert decision == pruner.decide(study, study.trials[trial.number])
            study.tell(trial, state=TrialState.PRUNED)
            return step, decision
    study.tell(trial, curve[-1])
    return None


SIX = [[90 - level - 5 * step for step in range(6)] for level in range(0, 30, 5)]
"""Scores in seconds of six trials, all getting better; 52.5 is their median at the fourth evaluation."""


def test_the_median_prunes_the_worse_half_after_its_warmup_and_names_both_scores():
    step, (name, reason) = pruned_at(study_of(SIX), build_pruner(settings("median")), [99, 98, 97, 96])
    assert (step, name) == (2, "median")
    assert reason == "98 is the best up to evaluation 2, 72.5 the median there, trials: 6"
    assert pruned_at(study_of(SIX), build_pruner(settings("median")), [64, 59, 54, 49]) is None


def test_no_trial_is_compared_before_the_startup_trials_are_complete():
    assert pruned_at(study_of(SIX[:3]), build_pruner(settings("median")), [99, 98, 97, 96]) is None


def test_the_percentile_keeps_the_best_share_only():
    curve = SIX[3]
    assert pruned_at(study_of(SIX), build_pruner(settings("median")), curve) is None
    step, (name, reason) = pruned_at(study_of(SIX), build_pruner(settings("percentile")), curve)
    assert (step, name) == (2, "percentile")
    assert reason == "70 is the best up to evaluation 2, 66.25 the bound of the best 25 % there, trials: 6"


def test_low_values_of_an_objective_to_maximize_are_pruned():
    study = study_of([[-score for score in curve] for curve in SIX], "maximize")
    pruner = build_pruner(settings("median", objectives=("completion",)))
    assert pruned_at(study, pruner, [-99, -98])[1].reason.startswith(
        "-98 is the best up to evaluation 2, -72.5"
    )
    assert pruned_at(study, pruner, [-64, -59]) is None


def test_hyperband_prunes_losers_of_a_rung_and_repeats_its_decision():
    study = study_of([])
    pruner = build_pruner(settings("hyperband", warmup_evaluations=0), evaluations=9)
    ends = [pruned_at(study, pruner, [50 - number + step for step in range(9)]) for number in range(12)]
    assert all(end is None for end in ends)  # each is the best so far
    ends = [pruned_at(study, pruner, [90 + number + step for step in range(9)]) for number in range(12)]
    assert {step for step, _ in ends} <= {1, 3, 9}
    assert {decision.name for _, decision in ends} == {"hyperband"}
    assert ends[0][1].reason.endswith("is not in the best third")


def test_a_patient_pruner_waits_while_a_trial_improves():
    better = [99, 98, 97, 96, 95, 94]
    stuck = [95, 95, 99, 99, 99, 99]
    for name in ("median", "percentile", "hyperband"):
        study = study_of(SIX)
        hasty = build_pruner(settings(name, warmup_evaluations=0), evaluations=6)
        patient = build_pruner(settings(name, warmup_evaluations=0, patience=2), evaluations=6)
        assert pruned_at(study, patient, better) is None
        if name != "hyperband":  # it looks at its rungs only
            assert pruned_at(study, hasty, better)[0] == 1
            assert pruned_at(study, patient, stuck)[0] == 5


@pytest.mark.parametrize("rival", ["median", "percentile", "hyperband"])
@pytest.mark.parametrize("patience", [None, 1])
def test_entropy_combines_with_each_comparing_pruner(tmp_path, rival, patience):
    pruner = build_pruner(settings("entropy", rival, patience=patience), evaluations=6)
    study = study_of(SIX)

    def trial_of(name: str, found: list[dict], curve: Sequence[float]) -> tuple | None:
        run = Run(tmp_path / name).begin().write(found)
        trial = study.ask()
        trial.set_user_attr("run_dir", str(run.path))
        for step, score in enumerate(curve, 1):
            trial.report(score, step)
        return pruner.decide(study, study.trials[trial.number])

    # The entropy says why, where both would give the trial up.
    assert trial_of("bad", collapsed(), [99, 98, 99, 99]).name == "collapsed"
    assert trial_of("good", converged(), [40, 35, 30, 25]) is None


def test_without_pruners_every_trial_continues(run):
    none = build_pruner(settings())
    assert run.begin().write(collapsed()).decision(none) is None
    assert pruned_at(study_of(SIX), none, [99, 99, 99]) is None


def test_optuna_asks_the_same_pruner():
    study = study_of(SIX)
    study.pruner = build_pruner(settings("entropy", "median"))
    trial = study.ask()
    trial.report(99, 1)
    assert not trial.should_prune()
    trial.report(99, 2)
    assert trial.should_prune()


def test_pruners_that_compare_one_score_are_refused_with_several_objectives():
    objectives = ("lap_time", "completion")
    refusal = r"^sweep\.pruners=\[entropy,median\]: median .*\[lap_time,completion\]; accepted .*\[entropy\]"
    with pytest.raises(BadInput, match=refusal):
        build_pruner(settings("entropy", "median", objectives=objectives))
    build_pruner(settings("entropy", objectives=objectives))


def seeded(*trials: Sequence[float], direction: str = "minimize") -> optuna.Study:
    """Return a study of complete trials with these values by seed."""
    study = optuna.create_study(direction=direction)
    for values in trials:
        runs = [{"seed": seed, "value": [value]} for seed, value in enumerate(values)]
        study.add_trial(create_trial(value=sum(values) / len(values), user_attrs={"runs": runs}))
    return study


FIVE = (10, 20, 30, 40, 50)


@pytest.mark.parametrize(
    ("best", "values", "is_worse"),
    [
        # One seed says nothing; then the trial must be worse on every seed so far, with one left.
        ((30, 32, 31), [36], False),
        ((30, 32, 31), [36, 35], True),
        ((30, 32, 31), [36, 31], False),
        ((30, 32, 31), [29, 31], False),
        # Seed by seed and not by their mean: worse than the same seed by less than the seeds differ.
        (FIVE, [11, 21, 31, 41], True),
        (FIVE, [41, 31, 21, 11], False),
        # More seeds need more lost seeds.
        ((30, 32, 31, 33), [36, 35], False),
        ((30, 32, 31, 33), [36, 35, 37], True),
        ((30, 32, 31, 33, 30, 31), [36, 35, 37], False),
        # Two seeds leave none to compare.
        ((30, 32), [36], False),
    ],
)
def test_wilcoxon_prunes_a_trial_that_is_worse_than_the_best_one_seed_by_seed(best, values, is_worse):
    assert is_worse_across_seeds(seeded((40, 42, 41), best), values) == is_worse


def test_wilcoxon_prunes_low_values_of_an_objective_to_maximize():
    study = seeded([90, 92, 91], direction="maximize")
    assert is_worse_across_seeds(study, [60, 70])
    assert not is_worse_across_seeds(study, [95, 96])


def test_wilcoxon_prunes_nothing_without_a_best_trial():
    assert not is_worse_across_seeds(seeded(), [36, 35])
    study = optuna.create_study(directions=["minimize", "maximize"])
    study.add_trial(create_trial(values=[30, 90]))
    assert not is_worse_across_seeds(study, [36, 35])
    build_pruner(settings("entropy", "wilcoxon", objectives=("lap_time", "completion")))
