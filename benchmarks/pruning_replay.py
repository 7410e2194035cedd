"""What a pruner of Optuna would have done with trials whose whole course is known.

A pruner sees of a trial nothing but the values it reports and when. So the values that a whole training has reported,
told to a study in memory step by step, make it say what it would have said while that training ran; a training that it
ends is the beginning of the whole one. What two workers do at the same time decides which values are there to compare
with: each of them is modelled by how long its trials take, at the pace that was measured.
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
    """A trial that nobody prunes."""

    number: int
    points: tuple[tuple[int, float], ...]
    """(env steps, value) of each evaluation on its way."""
    env_steps: int
    """At its end."""
    fate: str
    """How it ends by itself."""
    value: float | None
    """What it is worth then; None: nothing that could win."""


@dataclass(frozen=True, kw_only=True)
class Pace:
    """How long trials take."""

    step_s: float
    """A control step of one worker, learning included."""
    trial_s: float
    """What a trial takes besides."""


@dataclass(frozen=True, kw_only=True)
class Ended:
    """A trial as it came to its end."""

    number: int
    fate: str
    env_steps: int
    value: float | None
    """None: it was pruned, or failed."""
    began_s: float
    """Since the start of the sweep."""
    ended_s: float


def replay(
    courses: Sequence[Course],
    pruner: BasePruner,
    fate: str,
    *,
    pace: Pace,
    workers: int,
    direction: StudyDirection = StudyDirection.MINIMIZE,
    study_name: str = "replay",
) -> list[Ended]:
    """Make the trials once more, a pruner looking on; return them in their order.

    Args:
        courses: in the order in which they begin.
        pruner: is asked after each evaluation.
        fate: of the trials that it ends.
        pace: of all workers.
        workers: how many trials run at once; whichever is free first takes the next one.
        direction: of the values.
        study_name: chooses Hyperband's brackets, with the trial's number.
    """
    study = optuna.create_study(study_name=study_name, pruner=pruner, direction=direction)
    waiting, ended = iter(courses), list[Ended]()
    lines = [_worker(study, waiting, fate, pace, ended) for _ in range(workers)]
    moments = [(0.0, place) for place in range(workers)]
    while moments:
        _, place = heapq.heappop(moments)
        moment_s = next(lines[place], None)
        if moment_s is not None:
            heapq.heappush(moments, (moment_s, place))
    return sorted(ended, key=lambda one: one.number)


def _worker(
    study: optuna.Study, waiting: Iterator[Course], fate: str, pace: Pace, ended: list[Ended]
) -> Iterator[float]:
    """Make trial after trial; yield the moment of whatever comes next, and do it when called again."""
    now_s = 0.0
    for course in waiting:
        trial, began_s, beaten_at = study.ask(), now_s, None
        for step, (env_steps, value) in enumerate(course.points, 1):
            yield began_s + env_steps * pace.step_s
            trial.report(value, step)
            if trial.should_prune():
                beaten_at = env_steps
                break
        env_steps = course.env_steps if beaten_at is None else beaten_at
        now_s = began_s + env_steps * pace.step_s + pace.trial_s
        yield now_s
        _tell(study, trial, course, beaten_at is not None)
        ended.append(
            Ended(
                number=course.number,
                fate=course.fate if beaten_at is None else fate,
                env_steps=env_steps,
                value=course.value if beaten_at is None else None,
                began_s=began_s,
                ended_s=now_s,
            )
        )


def _tell(study: optuna.Study, trial: Trial, course: Course, beaten: bool) -> None:
    if beaten:
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
    """Return the trials that could win and had ended before all together had driven more steps than that."""
    return [
        one for one in ended if one.value is not None and steps_until(ended, one.ended_s, pace) <= env_steps
    ]
