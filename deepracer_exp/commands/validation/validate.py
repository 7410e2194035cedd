"""The command `validate`: call a reward function in many situations, print findings, draw the map, train briefly."""

import shlex
import time
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from rich.text import Text

from deepracer_exp.aws.worlds.catalogue import UNITS_PER_M
from deepracer_exp.aws.worlds.routes import recognise
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.race_files import RaceFiles
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.errors import BadInput, count, writing
from deepracer_exp.rewards.reward import RewardFailed
from deepracer_exp.tracks.track import Track
from deepracer_exp.training.plan import TrainPlan

from . import pitfalls
from .aws_dry_run import dry_run_findings
from .aws_rules import AwsFinding, text_findings
from .coverage import Coverage, never_executed
from .objects import with_others
from .pitfalls import LapReturn
from .probe import NOT_CALLED, Answer, Probe, lines_for_step_1
from .reward_map import RewardGrid, State, draw_reward_map, sample_reward_grid, state_of
from .short_training import train_shortly
from .simple_driver import action_space_laps, flawed_laps
from .situations import (
    FIRST_STEP,
    NamedSituation,
    Situations,
    named_situations,
    sample,
    seam,
    situations,
    start,
)

_MOST = 12
"""Most lines of one kind that are printed."""
_WARM = 25
"""Situations with which the time of a call is measured; the first calls may fill caches."""
_SAMPLES = ((0.5e-3, 2000), (2.5e-3, 400), (float("inf"), 80))
"""Number of sampled situations by CPU seconds per call, about one second in total."""
_DETAILS = ((0.3e-3, 1.0), (3e-3, 0.5), (30e-3, 0.25))
"""Resolution of the map by CPU seconds per call."""
_CARS = 128
"""Default cars of a process."""
_FIRST_CALL = f"steps is {FIRST_STEP} in the first call of an episode"
_SLOW_S = 1e-3
"""CPU seconds per call; with a fast reward, a step of these cars takes about 2 ms (`benchmarks.throughput`)."""


def validate_reward(
    plan: TrainPlan,
    trial: TrainPlan | None,
    output: str | None,
    strict: bool,
    out: Console,
    err: Console,
) -> int:
    """Validate the reward function of a plan, print the findings, draw its map and try a short training.

    Returns:
        The exit code: 0; 2 if the function cannot be used here, or, with `strict`, by AWS.

    Raises:
        BadInput: a file cannot be used or written; the function's module cannot be loaded.
        RunFailed: the short training failed.
    """
    check = read(plan.experiment, plan.files)
    setup = check.setup
    out.print(Text.assemble((setup.reward.name, "bold"), f" on {setup.track.title}\n"))
    _print_aws(out, check.aws)
    waypoints = setup.track.waypoints
    same = recognise(waypoints, np.arange(len(waypoints)))[:1]
    if not same or same[0].distance_m > 1 / UNITS_PER_M:
        _line(
            out, "Waypoints: numbered as in the track's own file or knots, not as in a track of the service"
        )
    try_named_situations(check)
    _print_situations(out, check)
    if not check.failures:
        look_closer(check)
    if not check.failures:
        _print_laps(out, check)
    _print_lines(out, "Warnings", "yellow", check.warnings)
    _print_lines(out, "Failures", "red", check.failures)
    if not check.failures:
        _draw(out, check, _default_picture(plan.experiment, check) if output is None else Path(output))
    if trial is not None and not check.failures and not (strict and check.aws):
        for line in train_shortly(err, trial):
            _line(out, line)
    return _verdict(out, check, strict)


@dataclass(kw_only=True)
class Check:
    """Findings about one reward function."""

    setup: RaceSetup
    against: Track
    """The track driven the other way."""
    discount: float
    """Discount of the experiment per control step."""
    aws: list[AwsFinding]
    """Reasons why deepracer-on-aws would refuse the function."""
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
    laps: list[LapReturn] = field(default_factory=list)
    """Returns of driven laps, slowest first; none where the function is too slow or constant."""
    flawed: dict[str, LapReturn] = field(default_factory=dict)
    """Returns of laps like the fastest of these, by their flaw."""
    grid: RewardGrid | None = None
    """None: not sampled, because a call takes too long."""


def read(experiment: Experiment, files: RaceFiles | None = None) -> Check:
    """Read an experiment's files, unless they were read, and find AWS's objections to its reward function.

    Raises:
        BadInput: a file cannot be used; the reward is not valid Python or lacks a one-argument `reward_function`;
            there are several tracks.
    """
    if len(experiment.tracks) > 1:
        names = ", ".join(experiment.tracks)
        raise BadInput(f"track=[{names}]", "a reward function is validated on one track", "one of these")
    setup = build_setup(experiment, files=files)
    (track,) = experiment.tracks.values()
    # A track driven in both directions is checked in the first of them.
    return Check(
        setup=with_others(setup.on(setup.track)),
        against=Track.from_config(track, reversed=track.direction != "reversed"),
        discount=experiment.algorithm.discount,
        aws=[*text_findings(setup.reward.text), *dry_run_findings(setup.reward, setup.track)],
    )


def try_named_situations(check: Check) -> None:
    """Call the function at the start and in the named situations, and add the results to `check`.

    Each situation comes after the start and the step before it, in a freshly loaded module.

    Raises:
        BadInput: the module cannot be loaded.
    """
    setup = check.setup
    probe = Probe(setup)
    check.tried["start"] = _with_its_line(setup, probe, probe.start, next(start(setup).params()))
    hangs = probe.hangs
    for case in named_situations(setup, check.against):
        answer = Answer(float("nan"), NOT_CALLED)
        if not hangs:
            probe = Probe(case.setup)
            answer = _act(probe, case)
            hangs = probe.hangs
        failed_with = next((params for _, params in probe.failures), None)
        check.tried[case.name] = _with_its_line(setup, probe, answer, failed_with)
    failed = {answer.failure for answer in check.tried.values()} - {None, NOT_CALLED}
    from_1 = _failures_from_step_1(check) if failed and not hangs else set(map(str, failed))
    for what in sorted(map(str, failed)):
        names = [name for name, answer in check.tried.items() if answer.failure == what]
        # Without the line that may precede it.
        fails_anyway = any(map(what.endswith, from_1))
        why = "" if fails_anyway else f"waits for steps == 1, and {_FIRST_CALL}: "
        check.failures.append(f"{why}{what}, at {', '.join(names)}")


def _failures_from_step_1(check: Check) -> set[str]:
    """Return the failures in the named situations if `steps` is 1 in the first call of an episode."""
    setup = check.setup
    cases = named_situations(setup, check.against)
    answers = [Probe(setup, 1).start, *(_act(Probe(case.setup, 1), case) for case in cases)]
    return {answer.failure for answer in answers if answer.failure is not None}


def _act(probe: Probe, case: NamedSituation) -> Answer:
    """Return the reward of a named situation, after the step before it."""
    before = probe.call(next(case.before.params()))
    return before if before.failure else probe.call(next(case.now.params()))


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
    else:
        try:
            check.warnings += pitfalls.batch_differs(setup, len(sampled))
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
    if setup.others is not None:
        check.warnings += pitfalls.mistakes_with_objects(setup)
    laps = action_space_laps(setup)
    check.warnings += pitfalls.pays_off_the_road(check.grid)
    check.warnings += pitfalls.pays_for_standing(setup, laps)
    check.laps = pitfalls.lap_returns(setup, laps, check.discount)
    check.warnings += pitfalls.slow_laps_return_as_much(check.laps, check.discount)
    if laps:
        flawed = flawed_laps(setup, laps[-1])
        returns = pitfalls.lap_returns(setup, list(flawed.values()), check.discount)
        check.flawed = dict(zip(flawed, returns, strict=True))
        check.warnings += pitfalls.flaws_return_more(check.laps[-1], check.flawed)


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
    places = sample(setup, n)
    now = situations(setup, places)
    before = situations(setup, places, earlier=True)
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


def _with_its_line(setup: RaceSetup, probe: Probe, answer: Answer, params: dict[str, Any] | None) -> Answer:
    """Return an answer with the line number in its failure, if it failed with these params."""
    if answer.failure is None or params is None:
        return answer
    return replace(answer, failure=_with_line(setup, probe, answer.failure, params))


def _with_line(setup: RaceSetup, probe: Probe, what: str, params: dict[str, Any]) -> str:
    """Prefix a bad return value with its line number, found by calling the function once more."""
    if what not in probe.without_line:
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
            f"{_with_line(setup, probe, what, params)}, {where}, {params['distance_from_center']:.2f} m {side} of the "
            f"centre line, progress {params['progress']:.1f}, steps {params['steps']:.0f}, "
            f"speed {params['speed']:.1f}, steering {params['steering_angle']:.0f}{often}"
        )
    return lines


def _unreached(text: str, lines: set[int], of: int) -> list[str]:
    written = text.split("\n")
    warnings = []
    at_step_1 = lines_for_step_1(text)
    for first, last in never_executed(text, lines):
        place = f"line {first}" if first == last else f"lines {first} to {last}"
        why = "" if at_step_1.isdisjoint(range(first, last + 1)) else f"; {_FIRST_CALL}"
        warnings.append(f"never reaches {place} in {of:,} situations: {written[first - 1].strip()}{why}")
    return warnings


def _default_picture(experiment: Experiment, check: Check) -> Path:
    folder = Path(experiment.runs_dir) / "validate"
    with writing(folder, "another runs_dir= or --output"):
        folder.mkdir(parents=True, exist_ok=True)
    return folder / f"{check.setup.reward.name}-{check.setup.track.name}.png"


def _line(out: Console, text: str, style: str | None = None) -> None:
    """Print one line without markup; a terminal may wrap it, a file gets it whole."""
    out.print(text, style=style, soft_wrap=True)


def _print_aws(out: Console, findings: list[AwsFinding]) -> None:
    """Print the objections of deepracer-on-aws, without style, and those of the AWS console's documentation."""
    documented, validator, style = (
        [str(finding) for finding in findings if finding.rule == rule]
        for rule in ("documented", "validator", "style")
    )
    _line(out, f"deepracer-on-aws: would {'refuse' if findings else 'accept'} it", "yellow" * bool(findings))
    _print_first(out, documented + validator)
    if style:
        _line(out, "  style (flake8; the AWS console trained functions with such findings):")
        _print_first(out, [f"  {line}" for line in style])
    console = "forbids what is named first above" if documented else "forbids nothing in it"
    _line(out, f"AWS console: its documentation {console}", "yellow" * bool(documented))


def _counted(findings: list[AwsFinding]) -> str:
    style = sum(finding.rule == "style" for finding in findings)
    return count(len(findings), "finding") + (f", {style} of style" if style else "")


def _print_situations(out: Console, check: Check) -> None:
    table = Table("situation", box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="dim")
    table.add_column("reward", justify="right")
    for name, answer in check.tried.items():
        how = Text("-", "dim") if answer.failure == NOT_CALLED else Text("failed", "red")
        table.add_row(name, f"{answer.reward:.4g}" if answer.failure is None else how)
    out.print()
    out.print(table)
    out.print()


def _print_laps(out: Console, check: Check) -> None:
    """Print the returns of laps of one line at several speeds, and of laps with a flaw."""
    if not check.laps:
        return
    table = Table("lap", "driven", box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="dim")
    for name in ("return", f"discounted by {check.discount:g} a step"):
        table.add_column(name, justify="right")
    *slower, good = check.laps
    named = [*(("slower", lap) for lap in slower), ("well", good), *check.flawed.items()]
    for name, lap in named:
        table.add_row(f"{lap.time_s:.2f} s", name, f"{lap.total:.4g}", f"{lap.discounted:.4g}")
    out.print(table, highlight=False)
    out.print()


def _draw(out: Console, check: Check, path: Path) -> None:
    paid = f"Reward per step: {check.lowest:.4g} to {check.highest:.4g} in {check.situations:,} situations"
    if check.state == "earlier calls":
        paid += "; it depends on earlier calls"
    _line(out, paid)
    if check.grid is None:
        _line(out, "No map and no laps: the function is too slow")
        return
    draw_reward_map(check.setup, check.grid, check.state, path)
    _line(out, f"Reward map: {shlex.quote(str(path))}")


def _print_lines(out: Console, title: str, style: str, lines: list[str]) -> None:
    if lines:
        _line(out, f"\n{title}", style)
        _print_first(out, lines)


def _print_first(out: Console, lines: list[str]) -> None:
    for line in lines[:_MOST]:
        _line(out, f"  {line}")
    if len(lines) > _MOST:
        _line(out, f"  and {len(lines) - _MOST} more")


def _verdict(out: Console, check: Check, strict: bool) -> int:
    out.print()
    if check.failures:
        _line(out, f"Verdict: cannot be used: {check.failures[0]}", "bold red")
        return 2
    refused = f"deepracer-on-aws would refuse it: {_counted(check.aws)}" if check.aws else ""
    if strict and refused:
        _line(out, f"Verdict: {refused}", "bold red")
        return 2
    warnings = f", with {count(len(check.warnings), 'warning')}" if check.warnings else ""
    _line(
        out,
        f"Verdict: can be trained here{warnings}{'; ' * bool(refused)}{refused}",
        "bold yellow" if warnings or refused else "bold green",
    )
    return 0
