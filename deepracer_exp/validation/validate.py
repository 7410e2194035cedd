"""The command `validate`: find out, tell, draw, try."""

import shlex
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from deepracer_exp.config.compose import Composition
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.errors import BadInput

from .check import Check, look_closer, other_direction, read, try_scenes
from .probe import NOT_CALLED
from .reward_map import draw_reward_map
from .trial import Trial, run_trial

_MOST = 12
"""Lines of one kind that are told."""


def validate(
    experiment: Experiment,
    trial: tuple[Experiment, Composition] | None,
    output: str | None,
    strict: bool,
    out: Console,
    err: Console,
) -> int:
    """Validate the reward function of an experiment and print what was found.

    Args:
        experiment: the reward function, the track, the car and the action space.
        trial: the same, as a short training; None: no training.
        output: the picture to write; None: named after reward function and track, beside the runs.
        strict: what the AWS console would refuse is refused.
        out: for the report.
        err: for the progress of the trial.

    Returns:
        The exit code: 0; 2 if the function cannot be used here, or by AWS and `strict` asks for that.

    Raises:
        BadInput: a file cannot be used or written; the function's module cannot be run.
        RunFailed: the trial failed.
    """
    check = read(experiment)
    setup = check.setup
    out.print(f"[bold]{escape(setup.reward.name)}[/bold] on {escape(setup.track.title)}\n", highlight=False)
    _tell_console(out, check)
    (track,) = experiment.tracks.values()
    if track.file is not None or track.knots is not None:
        _line(
            out, "Waypoints: numbered as in the track's own file or knots, not as in any world of the service"
        )
    against = other_direction(experiment)
    try_scenes(check, against)
    _tell_scenes(out, check)
    if not check.failures:
        look_closer(check, against)
    if not check.failures:
        _draw(out, check, _beside_the_runs(experiment, check) if output is None else Path(output))
    _tell_lines(out, "Warnings", "yellow", check.warnings)
    _tell_lines(out, "Failures", "red", check.failures)
    if trial is not None and not check.failures and not (strict and check.console):
        _tell_trial(out, run_trial(*trial, err))
    return _verdict(out, check, strict)


def _beside_the_runs(experiment: Experiment, check: Check) -> Path:
    folder = Path(experiment.runs_dir) / "validate"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(
            f"{folder}: cannot be made: {error.strerror}; runs_dir or --output says where else"
        ) from None
    return folder / f"{check.setup.reward.name}-{check.setup.track.name}.png"


def _line(out: Console, text: str, style: str | None = None) -> None:
    """Print one line as it is; a terminal may fold it, a file gets it whole."""
    out.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def _tell_console(out: Console, check: Check) -> None:
    if not check.console:
        _line(out, "AWS console: would take it")
        return
    _line(out, "AWS console: would refuse it", "yellow")
    for finding in check.console[:_MOST]:
        _line(out, f"  {finding}")
    if len(check.console) > _MOST:
        _line(out, f"  and {len(check.console) - _MOST} more")


def _tell_scenes(out: Console, check: Check) -> None:
    table = Table("situation", box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="dim")
    table.add_column("reward", justify="right")
    table.add_column("time a call", justify="right")
    for tried in check.tried:
        taken = "" if tried.microseconds is None else _time(tried.microseconds)
        failed = tried.answer.failure is not None
        how = "[dim]-[/dim]" if tried.answer.failure == NOT_CALLED else "[red]failed[/red]"
        table.add_row(tried.name, how if failed else f"{tried.answer.reward:.4g}", taken)
    out.print()
    out.print(table, highlight=False)
    out.print()


def _time(microseconds: float) -> str:
    return f"{microseconds:.3g} us" if microseconds < 1000 else f"{microseconds / 1000:,.3g} ms"


def _draw(out: Console, check: Check, path: Path) -> None:
    paid = f"Pays {check.lowest:.4g} to {check.highest:.4g} a step, in {check.situations:,} situations"
    if check.memory == "earlier calls":
        paid += "; what it pays depends on earlier calls"
    _line(out, paid)
    if check.survey is None or check.surveyor is None or check.detail is None:
        _line(out, "No map and no laps: a call takes too long")
        return
    setup = check.setup
    draw_reward_map(setup, check.surveyor, check.survey, check.memory, check.detail, path)
    _line(out, f"What it pays for: {shlex.quote(str(path))}")


def _tell_lines(out: Console, title: str, style: str, lines: list[str]) -> None:
    if not lines:
        return
    _line(out, f"\n{title}", style)
    for line in lines[:_MOST]:
        _line(out, f"  {line}")
    if len(lines) > _MOST:
        _line(out, f"  and {len(lines) - _MOST} more")


def _tell_trial(out: Console, trial: Trial) -> None:
    _line(out, f"\nTrial: {trial.env_steps:,} steps -> {trial.folder}")
    if not trial.changes:
        _line(out, "  too short to say whether anything rises; give it more time")
    for change in trial.changes:
        what = "rises" if change.rises else "does not rise"
        _line(
            out,
            f"  {change.name} {what}: {change.first:.4g} in the first third ({trial.first_episodes:,} episodes), "
            f"{change.last:.4g} in the last ({trial.last_episodes:,})",
        )


def _verdict(out: Console, check: Check, strict: bool) -> int:
    out.print()
    if check.failures:
        _line(out, f"Verdict: cannot be used: {check.failures[0]}", "bold red")
        return 2
    findings = f"{len(check.console)} finding{'s' if len(check.console) > 1 else ''}"
    if strict and check.console:
        _line(out, f"Verdict: the AWS console would refuse it: {findings}", "bold red")
        return 2
    count = len(check.warnings)
    warnings = f", with {count} warning{'s' if count > 1 else ''}" if count else ""
    refused = f"; the AWS console would refuse it: {findings}" if check.console else ""
    _line(
        out,
        f"Verdict: can be trained{warnings}{refused}",
        "bold yellow" if count or refused else "bold green",
    )
    return 0
