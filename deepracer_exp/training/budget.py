"""The budget of a run: use, exhaustion and alerts."""

import logging
import shlex
import subprocess
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from deepracer_exp.config.overrides import group_of
from deepracer_exp.config.running import BudgetConfig
from deepracer_exp.errors import BadInput, count
from deepracer_exp.lifeline import given_environment, running
from deepracer_exp.patience import communicate, ends, wait_patiently
from deepracer_exp.runs.next_steps import command_line, run_word
from deepracer_exp.runs.run_files import SUMMARY, read_config, read_object
from deepracer_exp.runs.run_result import FAILED, INTERRUPTED, Ending

_log = logging.getLogger(__name__)

_PATIENCE_S = 20.0
"""Time that an alert may take."""
_WORDS: dict[str, Callable[[float], str]] = {
    "env_steps": lambda used: count(round(used), "step"),
    "iterations": lambda used: count(round(used), "iteration"),
    "minutes": "{:,.4g} min".format,
}


@dataclass(frozen=True, kw_only=True)
class Alert:
    """A share of a limit that was passed."""

    limit: str
    """Key of the limit."""
    percent: int
    message: str


class Budget:
    """The limits of a run; the first one reached ends it."""

    def __init__(self, config: BudgetConfig):
        """Set the limits."""
        self._config = config
        self._alerted: dict[str, int] = {}

    def used(self, env_steps: int, iterations: int, wall_clock_s: float) -> tuple[str, float]:
        """Return the limit that is nearest and the share of it that is used, 1 or more once it is reached."""
        spent = self._spent(env_steps, iterations, wall_clock_s)
        return max(((limit, used / most) for limit, used, most in spent), key=lambda share: share[1])

    def scheduled(self, env_steps: int, iterations: int, wall_clock_s: float) -> float:
        """Return the position of schedules that follow the budget, 0 to 1 (their end); arguments as for `used`."""
        _, share = self.used(env_steps, iterations, wall_clock_s)
        return min(share / self._config.schedule_until, 1.0)

    def alerts(self, env_steps: int, iterations: int, wall_clock_s: float) -> list[Alert]:
        """Return alerts for shares passed since the last call, at most one per limit; the first call sets the start."""
        first, passed = not self._alerted, []
        for limit, used, most in self._spent(env_steps, iterations, wall_clock_s):
            percent = max((share for share in self._config.alerts if 100 * used >= share * most), default=0)
            if not first and percent > self._alerted[limit]:
                words = _WORDS[limit]
                message = f"{percent}% of budget.{limit} used: {words(used)} of {words(most)}"
                passed.append(Alert(limit=limit, percent=percent, message=message))
            self._alerted[limit] = max(percent, self._alerted.get(limit, 0))
        return passed

    def __str__(self) -> str:
        """Return the limits in words, e.g. ``3,000,000 steps``."""
        return " or ".join(_WORDS[name](most) for name, most in _limits(self._config).items())

    def _spent(self, env_steps: int, iterations: int, wall_clock_s: float) -> list[tuple[str, float, float]]:
        """Return key, use and value of each limit."""
        used = {"env_steps": env_steps, "iterations": iterations, "minutes": wall_clock_s / 60}
        return [(name, used[name], most) for name, most in _limits(self._config).items()]


class RunEnded(BadInput):
    """The run to resume has come to its end."""


def refuse_ended(run_dir: Path, config: BudgetConfig, overrides: Sequence[str]) -> None:
    """Refuse to resume a run that has ended.

    Overrides with another stopping rule void an ending by the run's own rule or by comparison with other runs, but not
    by a budget that is still used up.

    Raises:
        RunEnded: it says how the run can be resumed anyway.
    """
    summary = read_object(run_dir / SUMMARY)
    ending = Ending.stored(summary)
    if ending is None or ending.status in (INTERRUPTED, FAILED):
        return
    if ending.limit is None:
        if "stopping" in map(group_of, overrides):
            return
        clone = command_line("clone", run_word(run_dir), read_config(run_dir))
        raise RunEnded(
            f"{run_dir}: has ended ({ending}); stopping=none resumes it anyway, `{clone}` starts a new run "
            "from its best checkpoint"
        )
    used = Budget(config).used(summary["env_steps"], summary["iteration"], summary["wall_clock_s"])
    if used[1] >= 1:
        raise RunEnded(
            run_dir, f"has ended ({ending.reason}); to resume it, give it more, such as budget.{used[0]}="
        )


class Alerts:
    """Sends alerts to the command that the budget names, without delaying the training."""

    def __init__(self, config: BudgetConfig):
        """Parse the command.

        Raises:
            BadInput: its quotes do not close.
        """
        self._command = _command(config)
        self._threads: list[threading.Thread] = []

    def send(self, message: str, run_dir: Path) -> None:
        """Send a message about a run; errors are logged."""
        if self._command is not None:
            arguments = (self._command, message, run_dir)
            self._threads.append(
                threading.Thread(target=self._run, args=arguments, name="alert", daemon=True)
            )
            self._threads[-1].start()

    def close(self) -> None:
        """Wait up to 20 s for alerts still on their way; CPU time counts, while they compute."""
        for thread in self._threads:
            wait_patiently(ends(thread), _PATIENCE_S)

    def _run(self, command: tuple[str, ...], message: str, run_dir: Path) -> None:
        try:
            line, pipe = [*command, message, str(run_dir.resolve())], subprocess.PIPE
            environment, null = given_environment(), subprocess.DEVNULL
            with running(line, env=environment, stdin=null, stdout=pipe, stderr=pipe) as done:
                _, said = communicate(done, _PATIENCE_S)
        except TimeoutError as silence:
            _log.info("budget.alert_command was ended after %s", silence)
            return
        except OSError as error:
            _log.info("budget.alert_command cannot be run: %s", error.strerror or error)
            return
        if done.returncode:
            last = said.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
            _log.info("budget.alert_command ended with exit code %d: %s", done.returncode, last[0])


def _command(config: BudgetConfig) -> tuple[str, ...] | None:
    if config.alert_command is None:
        return None
    try:
        return tuple(shlex.split(config.alert_command))
    except ValueError as error:
        raise BadInput(
            f"budget.alert_command={config.alert_command}", error, "a program and its arguments"
        ) from error


def _limits(config: BudgetConfig) -> dict[str, float]:
    """Return the limits that are set, by their keys."""
    return {name: limit for name in _WORDS if (limit := getattr(config, name)) is not None}
