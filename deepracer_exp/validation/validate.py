"""The command `validate`: check a reward function, print the findings, draw the map, train briefly."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from deepracer_exp.config.compose import Composition
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.deepracer.routes import recognise
from deepracer_exp.deepracer.worlds import UNITS_PER_M
from deepracer_exp.errors import RunFailed, count, writing
from deepracer_exp.runs.files import METRICS, read_metrics

from .check import Check, look_closer, read, try_named_situations
from .probe import NOT_CALLED
from .reward_map import draw_reward_map

_MOST = 12
"""Most lines of one kind that are printed."""
_FEWEST = 6
"""Fewest iterations of a short training whose thirds can be compared."""


def validate_reward(
    experiment: Experiment,
    trial: tuple[Experiment, Composition] | None,
    output: str | None,
    strict: bool,
    out: Console,
    err: Console,
) -> int:
    """Validate the reward function of an experiment, print the findings, draw its map and try a short training.

    Returns:
        The exit code: 0; 2 if the function cannot be used here, or, with `strict`, by AWS.

    Raises:
        BadInput: a file cannot be used or written; the function's module cannot be loaded.
        RunFailed: the short training failed.
    """
    check = read(experiment)
    setup = check.setup
    out.print(f"[bold]{escape(setup.reward.name)}[/bold] on {escape(setup.track.title)}\n", highlight=False)
    _line(
        out,
        f"AWS console: would {'reject' if check.console else 'accept'} it",
        "yellow" * bool(check.console),
    )
    _print_first(out, list(map(str, check.console)))
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
        _draw(out, check, _default_picture(experiment, check) if output is None else Path(output))
    _print_lines(out, "Warnings", "yellow", check.warnings)
    _print_lines(out, "Failures", "red", check.failures)
    if trial is not None and not check.failures and not (strict and check.console):
        _train_shortly(out, err, *trial)
    return _verdict(out, check, strict)


def _default_picture(experiment: Experiment, check: Check) -> Path:
    folder = Path(experiment.runs_dir) / "validate"
    with writing(folder, "another runs_dir= or --output"):
        folder.mkdir(parents=True, exist_ok=True)
    return folder / f"{check.setup.reward.name}-{check.setup.track.name}.png"


def _line(out: Console, text: str, style: str | None = None) -> None:
    """Print one line without markup; a terminal may wrap it, a file gets it whole."""
    out.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def _print_situations(out: Console, check: Check) -> None:
    table = Table("situation", box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="dim")
    table.add_column("reward", justify="right")
    for name, answer in check.tried.items():
        how = "[dim]-[/dim]" if answer.failure == NOT_CALLED else "[red]failed[/red]"
        table.add_row(name, f"{answer.reward:.4g}" if answer.failure is None else how)
    out.print()
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


def _train_shortly(out: Console, err: Console, experiment: Experiment, composition: Composition) -> None:
    """Train and print whether anything improves.

    Raises:
        BadInput: the experiment cannot be trained.
        RunFailed: the training failed.
        KeyboardInterrupt: it was interrupted.
    """
    from deepracer_exp.training.run import run_training

    outcome = run_training(experiment, composition, err)
    if outcome.status == "failed":
        raise RunFailed(f"trial: run failed: {outcome.reason}; see {outcome.folder}")
    if outcome.status == "interrupted":
        raise KeyboardInterrupt
    rows = read_metrics(outcome.folder / METRICS)
    _line(out, f"\nTrial: {rows[-1]['env_steps'] if rows else 0:,} steps -> {outcome.folder}")
    for line in compare_thirds(rows) or ["too short to see whether anything improves; give it more time"]:
        _line(out, f"  {line}")


def compare_thirds(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Compare the first third of iterations, rows of metrics.jsonl, with the last; return a line for each metric.

    A metric improves if it rises by more than twice the standard error of the difference.
    """
    third = len(rows) // 3
    if len(rows) < _FEWEST:
        return []
    ended = np.diff([0, *(row["episodes"] for row in rows)])
    lines = []
    for key, name in (("completion", "per cent of the lap"), ("mean_return", "reward of an episode")):
        first, last = (
            np.array([row[key] for row in part if row[key] is not None])
            for part in (rows[:third], rows[-third:])
        )
        if len(first) < 2 or len(last) < 2:
            continue
        error = np.hypot(first.std(ddof=1) / np.sqrt(len(first)), last.std(ddof=1) / np.sqrt(len(last)))
        what = "improves" if last.mean() - first.mean() > 2 * error else "does not improve"
        lines.append(
            f"{name} {what}: {first.mean():.4g} in the first third ({ended[:third].sum():,} episodes), "
            f"{last.mean():.4g} in the last ({ended[-third:].sum():,})"
        )
    return lines


def _verdict(out: Console, check: Check, strict: bool) -> int:
    out.print()
    if check.failures:
        _line(out, f"Verdict: cannot be used: {check.failures[0]}", "bold red")
        return 2
    findings = count(len(check.console), "finding")
    if strict and check.console:
        _line(out, f"Verdict: the AWS console would reject it: {findings}", "bold red")
        return 2
    warnings = f", with {count(len(check.warnings), 'warning')}" if check.warnings else ""
    refused = f"; the AWS console would reject it: {findings}" if check.console else ""
    _line(
        out,
        f"Verdict: can be trained{warnings}{refused}",
        "bold yellow" if warnings or refused else "bold green",
    )
    return 0
