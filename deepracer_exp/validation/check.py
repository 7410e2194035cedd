"""Check a reward function without training: call it in many situations and collect failures and warnings."""

import time
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.reward import RewardFailed
from deepracer_exp.tracks.track import Track

from . import pitfalls
from .console import ConsoleFinding, console_findings
from .pitfalls import action_space_laps
from .probe import NOT_CALLED, Answer, Coverage, Probe, never_executed
from .reward_map import RewardGrid, State, sample_reward_grid, state_of
from .situations import NamedSituation, Situations, named_situations, sample, seam, situations

_WARM = 25
"""Situations with which the time of a call is measured; the first calls may fill caches."""
_SAMPLES = ((0.5e-3, 2000), (2.5e-3, 400), (float("inf"), 80))
"""Number of sampled situations by CPU seconds per call, about one second in total."""
_DETAILS = ((0.3e-3, 1.0), (3e-3, 0.5), (30e-3, 0.25))
"""Resolution of the map by CPU seconds per call."""
_CARS = 128
"""Default cars of a process."""
_SLOW_S = 1e-3
"""CPU seconds per call; with a fast reward, a step of these cars takes about 2 ms (`benchmarks.throughput`)."""


@dataclass(kw_only=True)
class Check:
    """Findings about one reward function."""

    setup: RaceSetup
    against: Track
    """The same track, driven the other way."""
    console: list[ConsoleFinding]
    tried: dict[str, Answer] = field(default_factory=dict)
    """The answers in the named situations."""
    failures: list[str] = field(default_factory=list)
    """Reasons why a training cannot use the function."""
    warnings: list[str] = field(default_factory=list)
    situations: int = 0
    """Number of situations sampled or named."""
    lowest: float = float("nan")
    highest: float = float("nan")
    state: State = "none"
    grid: RewardGrid | None = None
    """None: not sampled, because a call takes too long."""


def read(experiment: Experiment) -> Check:
    """Read an experiment's files and check the text of its reward function without running it.

    Raises:
        BadInput: a file cannot be used; the reward is not valid Python or lacks a one-argument `reward_function`;
            there are several tracks.
    """
    if len(experiment.tracks) > 1:
        names = ", ".join(experiment.tracks)
        raise BadInput(
            f"track=[{names}]: a reward function is validated on one track; accepted: one of these"
        )
    setup = build_setup(experiment)
    (track,) = experiment.tracks.values()
    # A track driven in both directions is checked in the first of them.
    return Check(
        setup=setup.on(setup.track),
        against=Track.from_config(track, reversed=track.direction != "reversed"),
        console=console_findings(setup.reward.text),
    )


def try_named_situations(check: Check) -> None:
    """Call the function in the named situations, each time in a freshly loaded module, and add the results to `check`.

    Raises:
        BadInput: the module cannot be loaded.
    """
    setup = check.setup
    hangs = False
    for case in named_situations(setup, check.against):
        probe = Probe(setup)
        answer = Answer(float("nan"), NOT_CALLED) if hangs else _act(probe, case)
        if probe.failures:
            answer = replace(answer, failure=_with_line(setup, *probe.failures[0]))
        hangs = hangs or probe.hangs
        check.tried[case.name] = answer
    failed = {answer.failure for answer in check.tried.values()} - {None, NOT_CALLED}
    for what in sorted(map(str, failed)):
        names = [name for name, answer in check.tried.items() if answer.failure == what]
        check.failures.append(f"{what}, at {', '.join(names)}")


def _act(probe: Probe, case: NamedSituation) -> Answer:
    """Return the reward of a named situation, after the step before it."""
    if case.before is not None:
        before = probe.call(next(case.before.params()))
        if before.failure:
            return before
    return probe.call(next(case.now.params()))


def look_closer(check: Check) -> None:
    """Call the function in many situations and add failures, warnings and the reward grid to `check`."""
    setup = check.setup
    probe = Probe(setup)
    plain_s = _cpu_s_per_call(probe, setup)
    detail = next((detail for limit_s, detail in _DETAILS if plain_s < limit_s), None)
    if not probe.hangs:
        check.state = state_of(setup, Probe(setup), 40 if detail else 5)
        executed, n = _execute_scenes(probe, check) if detail else (None, _SAMPLES[-1][1])
        sampled, rewards = _sample(check, probe, executed, n)
    check.failures += _failures(setup, probe)
    if check.failures:
        return

    paid = np.append(rewards, [answer.reward for answer in check.tried.values()])
    check.lowest, check.highest = float(paid.min()), float(paid.max())
    last_point = Probe(setup).call(next(seam(setup).params()))
    if last_point.failure:
        check.warnings.append(f"at the finish, between the last waypoint and the first: {last_point.failure}")
    if plain_s > _SLOW_S:
        waits = f"a step of {_CARS} cars waits {_CARS * plain_s:.2g} s for it"
        check.warnings.append(f"takes {plain_s * 1e3:.2g} ms of CPU a call: {waits}")
    if check.state == "randomness":
        check.warnings.append(
            "returns different rewards for the same calls: it draws random numbers or reads a clock"
        )
    elif check.state == "none":
        try:
            check.warnings += pitfalls.batch_differs(setup, sampled, rewards)
        except (BadInput, RewardFailed) as error:
            check.failures.append(str(error))
            return
    constant = list(pitfalls.constant_reward(paid))
    check.warnings += constant
    if executed is not None:
        check.warnings += _unreached(setup.reward.text, executed.lines, check.situations)
    if detail is None:
        return
    check.grid = sample_reward_grid(setup, check.state, detail)
    if constant:  # the other warnings would only repeat it
        return
    laps = action_space_laps(setup)
    check.warnings += pitfalls.pays_off_the_road(check.grid)
    check.warnings += pitfalls.pays_for_standing(setup, laps)
    check.warnings += pitfalls.pays_for_slowness(setup, laps)


def _execute_scenes(probe: Probe, check: Check) -> tuple[Coverage, int]:
    """Return the lines executed in the named situations, and how many more situations to sample."""
    setup = check.setup
    with Coverage(setup.reward.path) as executed:
        for case in named_situations(setup, check.against):
            _act(probe, case)
        Probe(setup).call(next(seam(setup).params()))
        traced_s = _cpu_s_per_call(probe, setup)
    return executed, next(n for limit_s, n in _SAMPLES if traced_s < limit_s)


def _sample(
    check: Check, probe: Probe, executed: Coverage | None, n: int
) -> tuple[Situations, NDArray[np.float64]]:
    """Return n sampled situations and their rewards; adds the number of situations to `check`."""
    setup = check.setup
    at = sample(setup, n)
    now = situations(setup, at)
    before = situations(setup, at, earlier=True)
    with executed or nullcontext():
        rewards = probe.rewards(now, before if check.state == "earlier calls" else None)
    check.situations = n + len(check.tried)
    return now, rewards


def _cpu_s_per_call(probe: Probe, setup: RaceSetup) -> float:
    """Return the median CPU time of a call in seconds, which does not depend on the load of the machine."""
    times: list[float] = []
    for params in situations(setup, sample(setup, _WARM)).params():
        began = time.thread_time()
        probe.call(params)
        times.append(time.thread_time() - began)
        if len(times) >= 3 and sum(times) > 0.5:
            break
    return float(np.median(times))


def _with_line(setup: RaceSetup, what: str, params: dict[str, Any]) -> str:
    """Prefix a bad return value with its line number, found by calling the function once more."""
    if not what.startswith("returned"):
        return what
    with Coverage(setup.reward.path) as coverage:
        again = Probe(setup).call(dict(params))  # it may change them
    return f"line {coverage.returned_at} {what}" if again.failure == what else what


def _failures(setup: RaceSetup, probe: Probe) -> list[str]:
    """Return each kind of failure once, with the first situation in which it occurred."""
    first = dict(reversed(probe.failures))
    lines = []
    for what, n in Counter(what for what, _ in probe.failures).items():
        params = first[what]
        side = "left" if params["is_left_of_center"] else "right"
        where = "off the track" if params["is_offtrack"] else "on the road"
        often = f" ({n:,} of {probe.calls:,} situations)" if n > 1 else ""
        lines.append(
            f"{_with_line(setup, what, params)}, {where}, {params['distance_from_center']:.2f} m {side} of the "
            f"centre line, progress {params['progress']:.1f}, steps {params['steps']:.0f}, "
            f"speed {params['speed']:.1f}, steering {params['steering_angle']:.0f}{often}"
        )
    return lines


def _unreached(text: str, lines: set[int], of: int) -> list[str]:
    written = text.split("\n")
    warnings = []
    for first, last in never_executed(text, lines):
        place = f"line {first}" if first == last else f"lines {first} to {last}"
        warnings.append(f"never reaches {place} in {of:,} situations: {written[first - 1].strip()}")
    if warnings and ("object" in text or "is_crashed" in text):
        warnings[-1] += "  (there are no objects on the track here)"
    return warnings
