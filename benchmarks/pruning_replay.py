"""What one of Optuna's pruners would have done with trials that are known to their ends.

A pruner sees nothing of a trial but the values it reports and their steps. So the values of a complete training,
reported to a study in memory step by step, give the decisions that the pruner would have made during that training; a
pruned training is the beginning of the complete one. Which values there are to compare with depends on what the other
workers do at the same time: each worker is modelled by how long its trials take, at the measured pace.
"""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import optuna
from optuna.pruners import BasePruner
from optuna.study import StudyDirection
from optuna.trial import Trial, TrialState


@dataclass(frozen=True, kw_only=True)
class Course:
    """A trial without pruning."""

    number: int
    points: tuple[tuple[int, float], ...]
    """(env steps, value) of each evaluation before its end."""
    env_steps: int
    """At its end."""
    outcome: str
    """How it ends by itself."""
    value: float | None
    """Its value then; None: it failed."""


@dataclass(frozen=True, kw_only=True)
class Pace:
    """How long trials take."""

    step_s: float
    """A control step of one worker, learning included."""
    trial_s: float
    """The rest of a trial, seconds."""


@dataclass(frozen=True, kw_only=True)
class Ended:
    """A trial that has ended."""

    number: int
    outcome: str
    env_steps: int
    value: float | None
    """None: it was pruned, or failed."""
    began_s: float
    """Since the start of the sweep."""
    ended_s: float


def replay(
    courses: Sequence[Course],
    pruner: BasePruner,
    outcome: str,
    *,
    pace: Pace,
    workers: int,
    direction: StudyDirection = StudyDirection.MINIMIZE,
    study_name: str = "replay",
) -> list[Ended]:
    """Replay trials with a pruner; return them in their order.

    Args:
        courses: in the order in which they begin.
        pruner: asked after each evaluation.
        outcome: of the trials that it prunes.
        pace: of all workers.
        workers: how many trials run at once; the first free one takes the next trial.
        direction: of the values.
        study_name: chooses Hyperband's brackets, with the trial's number.
    """
    study = optuna.create_study(study_name=study_name, pruner=pruner, direction=direction)
    waiting, ended = iter(courses), list[Ended]()
    lines = [_worker(study, waiting, outcome, pace, ended) for _ in range(workers)]
    moments = [(0.0, place) for place in range(workers)]
    while moments:
        _, place = heapq.heappop(moments)
        moment_s = next(lines[place], None)
        if moment_s is not None:
            heapq.heappush(moments, (moment_s, place))
    return sorted(ended, key=lambda one: one.number)


def _worker(
    study: optuna.Study, waiting: Iterator[Course], outcome: str, pace: Pace, ended: list[Ended]
) -> Iterator[float]:
    """Make trial after trial; yield the time of the next event, which happens at the next call."""
    now_s = 0.0
    for course in waiting:
        trial, began_s, pruned_at = study.ask(), now_s, None
        for step, (env_steps, value) in enumerate(course.points, 1):
            yield began_s + env_steps * pace.step_s
            trial.report(value, step)
            if trial.should_prune():
                pruned_at = env_steps
                break
        env_steps = course.env_steps if pruned_at is None else pruned_at
        now_s = began_s + env_steps * pace.step_s + pace.trial_s
        yield now_s
        _report(study, trial, course, pruned_at is not None)
        ended.append(
            Ended(
                number=course.number,
                outcome=course.outcome if pruned_at is None else outcome,
                env_steps=env_steps,
                value=course.value if pruned_at is None else None,
                began_s=began_s,
                ended_s=now_s,
            )
        )


def _report(study: optuna.Study, trial: Trial, course: Course, pruned: bool) -> None:
    if pruned:
        study.tell(trial, state=TrialState.PRUNED)
    elif course.value is None:
        study.tell(trial, state=TrialState.FAIL)
    else:
        study.tell(trial, course.value)


def makespan_s(ended: Sequence[Ended]) -> float:
    """Return when the last trial ended."""
    return max((one.ended_s for one in ended), default=0.0)


def steps_until(ended: Sequence[Ended], moment_s: float, pace: Pace) -> int:
    """Return the control steps that all trials together had driven by a moment."""
    return sum(min(max(int((moment_s - one.began_s) / pace.step_s), 0), one.env_steps) for one in ended)


def found_within(ended: Sequence[Ended], env_steps: int, pace: Pace) -> list[Ended]:
    """Return the trials with a value that had ended before all together had driven more steps than that."""
    return [
        one for one in ended if one.value is not None and steps_until(ended, one.ended_s, pace) <= env_steps
    ]
