"""Everything that is found out about a reward function without training."""

import time
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.reward import RewardFailed
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.errors import BadInput
from deepracer_exp.tracks.track import Track

from . import pitfalls
from .console import console_findings
from .coverage import Coverage, never_executed
from .findings import Finding
from .laps import action_space_laps
from .probe import NOT_CALLED, Answer, Probe
from .scenes import Scene, sample, scenes, seam
from .situations import Situations, situations
from .survey import Memory, Survey, Surveyor, memory_of, survey

_WARM = 25
"""Situations by which the time of a call is judged; the first calls may compute much."""
_SAMPLES = ((0.5e-3, 2000), (2.5e-3, 400), (float("inf"), 80))
"""How many situations are sampled, by CPU seconds a call: about one second."""
_DETAILS = ((0.3e-3, 1.0), (3e-3, 0.5), (30e-3, 0.25))
"""How finely the map is drawn, likewise."""
_SLOW_S = 1e-3
"""A step of the default 64 cars a process takes 5 ms without the reward."""


@dataclass(frozen=True)
class Trying:
    """One named situation and what the function made of it."""

    name: str
    answer: Answer
    microseconds: float | None


@dataclass(kw_only=True)
class Check:
    """What was found out."""

    setup: RaceSetup
    console: list[Finding]
    tried: list[Trying] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    """Why a training could not use the function."""
    warnings: list[str] = field(default_factory=list)
    situations: int = 0
    """How many were looked at."""
    lowest: float = float("nan")
    highest: float = float("nan")
    memory: Memory = "none"
    detail: float | None = None
    """Of the map; None: there is none, since a call takes too long."""
    surveyor: Surveyor | None = None
    survey: Survey | None = None


def read(experiment: Experiment) -> Check:
    """Read the files of an experiment and look at the text of its reward function, without running it.

    Raises:
        BadInput: a file cannot be used; what is no valid Python, or has no `reward_function` of one argument;
            several tracks.
    """
    if len(experiment.tracks) > 1:
        names = ", ".join(experiment.tracks)
        raise BadInput(
            f"track=[{names}]: a reward function is validated on one track; accepted: one of these"
        )
    setup = build_setup(experiment)
    # Of a track that is driven in both directions the first is looked at.
    return Check(setup=setup.on(setup.track), console=console_findings(setup.reward.text))


def try_scenes(check: Check, against: Track) -> None:
    """Call the function in the named situations; each time in a module of its own, as in a new process.

    Args:
        check: what is known; added to.
        against: the track in the other direction.

    Raises:
        BadInput: the module cannot be run.
    """
    setup = check.setup
    hangs = False
    for scene in scenes(setup, against):
        probe = Probe(setup.reward, setup.reward_time_limit_s)
        answer = Answer(float("nan"), NOT_CALLED) if hangs else _act(probe, scene)
        if probe.failures:
            answer = replace(answer, failure=_with_line(setup, *probe.failures[0]))
        hangs = hangs or probe.hangs
        taken = None if answer.failure else probe.median_s(next(scene.now.params()))
        check.tried.append(Trying(scene.name, answer, None if taken is None else taken * 1e6))
    failed = {tried.answer.failure for tried in check.tried} - {None, NOT_CALLED}
    for what in sorted(map(str, failed)):
        names = [tried.name for tried in check.tried if tried.answer.failure == what]
        check.failures.append(f"{what}, at {', '.join(names)}")


def _act(probe: Probe, scene: Scene) -> Answer:
    """Ask what a scene pays, after what came before it."""
    if scene.before is not None:
        before = probe.ask(next(scene.before.params()))
        if before.failure:
            return before
    return probe.ask(next(scene.now.params()))


def look_closer(check: Check, against: Track) -> None:
    """Call the function in many situations and note what may go wrong; adds to `check`."""
    setup, source = check.setup, check.setup.reward
    probe = Probe(source, setup.reward_time_limit_s)
    plain_s = _cpu_s_per_call(probe, setup)
    check.detail = next((detail for limit_s, detail in _DETAILS if plain_s < limit_s), None)
    if not probe.hangs:
        check.memory = memory_of(setup, Probe(source, setup.reward_time_limit_s), 40 if check.detail else 5)
        executed, n = _execute_scenes(probe, setup, against) if check.detail else (None, _SAMPLES[-1][1])
        asked, rewards = _sample(check, probe, executed, n)
    check.failures += _told(setup, probe, check.situations)
    if check.failures:
        return

    last_point = Probe(source, setup.reward_time_limit_s).ask(next(seam(setup).params()))
    if last_point.failure:
        check.warnings.append(
            f"where the last waypoint is behind and the first ahead, which are one place: {last_point.failure}"
        )
    if plain_s > _SLOW_S:
        waits = f"a step of 64 cars waits {64 * plain_s:.2g} s for it"
        check.warnings.append(f"takes {plain_s * 1e3:.2g} ms of CPU a call: {waits}")
    if check.memory == "chance":
        check.warnings.append(
            "pays differently for the same calls: it draws random numbers or looks at a clock"
        )
    elif check.memory == "none":
        try:
            check.warnings += pitfalls.batch_differs(setup, asked, rewards)
        except (BadInput, RewardFailed) as error:
            check.failures.append(str(error))
            return
    constant = list(pitfalls.constant_reward(rewards))
    check.warnings += constant
    if executed is not None:
        check.warnings += _unreached(source.text, executed.lines, check.situations)
    if check.detail is None:
        return
    check.surveyor = Surveyor(setup, check.memory)
    check.survey = survey(setup, check.surveyor, check.detail)
    if constant:  # which the other warnings would only say in other words
        return
    laps = action_space_laps(setup)
    check.warnings += pitfalls.pays_off_the_road(check.survey)
    check.warnings += pitfalls.pays_for_standing(setup, laps)
    check.warnings += pitfalls.pays_for_slowness(setup, laps)


def _execute_scenes(probe: Probe, setup: RaceSetup, against: Track) -> tuple[Coverage, int]:
    """Note the lines executed in the named situations; return them, and how many more situations to look at."""
    with Coverage(setup.reward.path) as executed:
        for scene in scenes(setup, against):
            _act(probe, scene)
        Probe(setup.reward, setup.reward_time_limit_s).ask(next(seam(setup).params()))
        traced_s = _cpu_s_per_call(probe, setup)
    return executed, next(n for limit_s, n in _SAMPLES if traced_s < limit_s)


def _sample(
    check: Check, probe: Probe, executed: Coverage | None, n: int
) -> tuple[Situations, NDArray[np.float64]]:
    """Ask in n situations and note what is paid; return both."""
    setup = check.setup
    at = sample(setup, n)
    now = situations(setup, at)
    before = situations(setup, at, earlier=True)
    with executed or nullcontext():
        rewards = probe.rewards(now, before if check.memory == "earlier calls" else None)
    check.situations = n + len(check.tried)
    known = rewards[np.isfinite(rewards)]
    if len(known):
        check.lowest, check.highest = float(known.min()), float(known.max())
    return now, rewards


def other_direction(experiment: Experiment) -> Track:
    """Return the experiment's track driven the other way."""
    track = next(iter(experiment.tracks.values()))
    return Track.from_config(track, reversed=track.direction != "reversed")


def _cpu_s_per_call(probe: Probe, setup: RaceSetup) -> float:
    """Return the median CPU time of a call, which does not depend on what else the machine does."""
    times: list[float] = []
    for params in situations(setup, sample(setup, _WARM)).params():
        began = time.thread_time()
        probe.ask(params)
        times.append(time.thread_time() - began)
        if len(times) >= 3 and sum(times) > 0.5:
            break
    return float(np.median(times))


def _with_line(setup: RaceSetup, what: str, params: dict[str, Any]) -> str:
    """Add the line from which something was returned that is no reward; it is found by calling once more."""
    if not what.startswith("returned"):
        return what
    with Coverage(setup.reward.path) as coverage:
        again = Probe(setup.reward, setup.reward_time_limit_s).ask(params)
    return f"line {coverage.returned_at} {what}" if again.failure == what else what


def _told(setup: RaceSetup, probe: Probe, of: int) -> list[str]:
    """Return each kind of failure once, with its first situation."""
    counts: dict[str, int] = {}
    first: dict[str, str] = {}
    for what, params in probe.failures:
        counts[what] = counts.get(what, 0) + 1
        if what in first:
            continue
        side = "left" if params["is_left_of_center"] else "right"
        where = "off the track" if params["is_offtrack"] else "on the road"
        first[what] = (
            f"{_with_line(setup, what, params)}, {where}, {params['distance_from_center']:.2f} m {side} of the "
            f"centre line, progress {params['progress']:.1f}, steps {params['steps']:.0f}, "
            f"speed {params['speed']:.1f}, steering {params['steering_angle']:.0f}"
        )
    return [first[what] + (f" ({n} of {of:,} situations)" if n > 1 else "") for what, n in counts.items()]


def _unreached(text: str, lines: set[int], of: int) -> list[str]:
    written = text.splitlines()
    told = []
    for first, last in never_executed(text, lines):
        place = f"line {first}" if first == last else f"lines {first} to {last}"
        told.append(f"never gets to {place} in {of:,} situations: {written[first - 1].strip()}")
    if told and ("object" in text or "is_crashed" in text):
        told[-1] += "  (there are no objects on the road here)"
    return told
