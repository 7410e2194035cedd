"""The budget: what a run and all runs of its experiment have used of it, whether any is left, and alerts."""

import json
import logging
import os
import shlex
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from deepracer_exp.config.overrides import group_of
from deepracer_exp.config.running import BudgetConfig
from deepracer_exp.errors import BadInput, count
from deepracer_exp.files import RECORD_BYTES, open_user_file, read_bytes
from deepracer_exp.lifeline import given_environment, running
from deepracer_exp.lookup.next_steps import command_line, run_word
from deepracer_exp.patience import communicate, ends, wait_patiently
from deepracer_exp.runs.files import METRICS, SUMMARY, WRITTEN, read_config, read_object
from deepracer_exp.runs.result import FAILED, INTERRUPTED, Ending

_log = logging.getLogger(__name__)

_PATIENCE_S = 20.0
"""Time that an alert may take."""
_REFRESH_S = 10.0  # between two looks at what other runs have used
_TAIL_BYTES = 131_072  # more than a line of metrics.jsonl with all tracks of the catalogue
_WORDS: dict[str, Callable[[float], str]] = {
    "env_steps": lambda used: count(round(used), "step"),
    "iterations": lambda used: count(round(used), "iteration"),
    "minutes": "{:,.4g} min".format,
    "max_cost": "{:,.2f} in cost".format,
}
_EXPERIMENT = "experiment_"
"""Beginning of the keys of limits that all runs of an experiment share."""
_WORDS_BY_KEY = _WORDS | {f"{_EXPERIMENT}{name}": words for name, words in _WORDS.items()}


@dataclass(frozen=True, kw_only=True)
class Alert:
    """A share of a limit that was passed."""

    limit: str
    """Key of the limit."""
    percent: int
    message: str


class Budget:
    """The limits of a run and of its experiment; the first one reached ends the run."""

    def __init__(self, config: BudgetConfig, folder: Path):
        """Set the limits of the run in `folder`; the folders beside it are the other runs of the experiment."""
        self._config, self._folder = config, folder
        self._others: dict[str, float] = {}
        self._look_again_at = 0.0
        self._alerted: dict[str, int] = {}

    def used(self, env_steps: int, iterations: int, wall_clock_s: float) -> tuple[str, float]:
        """Return the limit that is nearest and the share of it that is used, 1 or more once it is reached.

        Of a limit of the experiment, the share is that of what the other runs leave: 0 at this run's start.
        """
        shares = []
        for limit, own_use, others, most in self._spent(env_steps, iterations, wall_clock_s):
            shares.append((limit, own_use / (most - others) if most > others else 1.0))
        return max(shares, key=lambda share: share[1])

    def scheduled(self, env_steps: int, iterations: int, wall_clock_s: float) -> float:
        """Return where the schedules that follow the budget are, 0 to 1, their end; arguments as of `used`."""
        _, share = self.used(env_steps, iterations, wall_clock_s)
        return min(share / self._config.schedule_until, 1.0)

    def alerts(self, env_steps: int, iterations: int, wall_clock_s: float) -> list[Alert]:
        """Return what was passed since the last call, at most one alert a limit; the first call sets the start."""
        first, passed = not self._alerted, []
        for limit, own_use, others, most in self._spent(env_steps, iterations, wall_clock_s):
            spent = own_use + others
            percent = max((share for share in self._config.alerts if 100 * spent >= share * most), default=0)
            if not first and percent > self._alerted[limit]:
                words = _WORDS_BY_KEY[limit]
                message = f"{percent}% of budget.{limit} used: {words(spent)} of {words(most)}"
                passed.append(Alert(limit=limit, percent=percent, message=message))
            self._alerted[limit] = max(percent, self._alerted.get(limit, 0))
        return passed

    def cost(self, wall_clock_s: float) -> float | None:
        """Return what the run has cost, None where no price is given."""
        price = self._config.price_per_hour
        return None if price is None else round(price * wall_clock_s / 3600, 6)

    def __str__(self) -> str:
        """Return the limits in words, e.g. ``3,000,000 steps``."""
        words = [_WORDS[name](most) for name, most in _limits(self._config).items()]
        shared = _limits(self._config, _EXPERIMENT)
        words += [f"{_WORDS[name](most)} of all runs" for name, most in shared.items()]
        return " or ".join(words)

    def _spent(
        self, env_steps: int, iterations: int, wall_clock_s: float
    ) -> list[tuple[str, float, float, float]]:
        """Return of each limit its key, what this run has used of it, what the others have, and the limit."""
        used_here = {
            "env_steps": env_steps,
            "iterations": iterations,
            "minutes": wall_clock_s / 60,
            "max_cost": self.cost(wall_clock_s) or 0.0,
        }
        limits = [(name, used_here[name], 0.0, most) for name, most in _limits(self._config).items()]
        shared = _limits(self._config, _EXPERIMENT)
        if shared:
            # They may run at the same time.
            if time.monotonic() >= self._look_again_at:
                self._others = _spent_in(self._folder.parent, self._config, besides=self._folder.name)
                self._look_again_at = time.monotonic() + _REFRESH_S
            limits += [
                (f"{_EXPERIMENT}{name}", used_here[name], self._others[name], most)
                for name, most in shared.items()
            ]
        return limits


def refuse_spent(config: BudgetConfig, experiment_dir: Path) -> None:
    """Refuse to start a run of an experiment that has nothing left.

    The folder of the experiment's runs need not exist.

    Raises:
        BadInput: a limit is reached; it is named with what was used.
    """
    limits = _limits(config, _EXPERIMENT)
    spent = _spent_in(experiment_dir, config) if limits else {}
    for name, most in limits.items():
        if spent[name] >= most:
            raise BadInput(
                f"budget.{_EXPERIMENT}{name}={most:g}: the runs in {experiment_dir} have used {spent[name]:,.6g} "
                "already; accepted: more than that, or another name="
            )


class RunEnded(BadInput):
    """The run to resume has come to its end."""


def refuse_ended(run_dir: Path, config: BudgetConfig, overrides: Sequence[str]) -> None:
    """Refuse to resume a run that has ended.

    With another stopping rule among the overrides, what ended it, its own rule or a comparison with other runs, does
    not count; a budget that is still used up does.

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
    used = Budget(config, run_dir).used(summary["env_steps"], summary["iteration"], summary["wall_clock_s"])
    if used[1] >= 1:
        raise RunEnded(
            run_dir, f"has ended ({ending.reason}); to resume it, give it more, such as budget.{used[0]}="
        )


class Alerts:
    """Sends alerts to a command and to a webhook, where the budget names them; neither delays the training."""

    def __init__(self, config: BudgetConfig):
        """Parse the command and look up the webhook's address.

        Raises:
            BadInput: the command's quotes do not close, or the environment variable is not set or holds no address.
        """
        self._command = _command(config)
        self._address = _webhook_address(config)
        self._threads: list[threading.Thread] = []

    def send(self, message: str, run_dir: Path) -> None:
        """Send a message of a run; errors are logged."""
        for wanted, how in ((self._command, self._run), (self._address, self._post)):
            if wanted is not None:
                arguments = (wanted, message, run_dir)
                self._threads.append(threading.Thread(target=how, args=arguments, name="alert", daemon=True))
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

    def _post(self, address: str, message: str, _: Path) -> None:
        # Slack and Mattermost read `text`, Discord `content`.
        body = json.dumps({"text": message, "content": message}).encode()
        request = urllib.request.Request(address, body, {"Content-Type": "application/json"})
        try:
            with urllib.request.urlopen(request, timeout=_PATIENCE_S):
                pass
        except urllib.error.HTTPError as error:
            _log.info("budget.alert_webhook answered %d", error.code)
        except OSError as error:
            # Not the error's text: it may hold the address.
            _log.info("budget.alert_webhook cannot be reached (%s)", type(error).__name__)


def _command(config: BudgetConfig) -> tuple[str, ...] | None:
    if config.alert_command is None:
        return None
    try:
        return tuple(shlex.split(config.alert_command))
    except ValueError as error:
        raise BadInput(
            f"budget.alert_command={config.alert_command}", error, "a program and its arguments"
        ) from error


def _webhook_address(config: BudgetConfig) -> str | None:
    name = config.alert_webhook
    if name is None:
        return None
    address = os.environ.get(name)
    if address is None:
        raise BadInput(
            f"budget.alert_webhook={name}: no such environment variable; accepted: the name of one that holds the "
            "webhook's address"
        )
    parts = urlsplit(address)
    if parts.scheme not in ("http", "https") or not parts.netloc:
        raise BadInput(
            f"budget.alert_webhook={name}: the variable holds no address that begins with http:// or https://"
        )
    return address


def _limits(config: BudgetConfig, prefix: str = "") -> dict[str, float]:
    """Return the limits that are set, by their keys without the prefix."""
    return {name: limit for name in _WORDS if (limit := getattr(config, f"{prefix}{name}", None)) is not None}


def _spent_in(folder: Path, config: BudgetConfig, besides: str | None = None) -> dict[str, float]:
    """Return what all run folders in `folder` but the one called `besides` have used, by the limits' keys."""
    spent = dict.fromkeys(_WORDS, 0.0)
    runs = [run for run in folder.iterdir() if run.name != besides] if folder.is_dir() else []
    for row in map(_last_row, runs):
        if row:
            price = (config.price_per_hour or 0.0) * row["wall_clock_s"] / 3600
            spent["env_steps"] += row["env_steps"]
            spent["minutes"] += row["wall_clock_s"] / 60
            spent["max_cost"] += price if row["cost"] is None else row["cost"]
    return spent


def _last_row(run: Path) -> dict[str, Any]:
    """Return the summary of a run, or its last whole row if it has none; empty where nothing can be read."""
    try:
        if (run / SUMMARY).exists():
            text = read_bytes(run / SUMMARY, WRITTEN, RECORD_BYTES)
        else:  # it is running, or was killed
            with open_user_file(run / METRICS, WRITTEN, RECORD_BYTES) as file:
                file.seek(max(0, file.seek(0, 2) - _TAIL_BYTES))
                text = file.read().split(b"\n")[-2]
        row = dict(json.loads(text))
        return {"env_steps": row["env_steps"], "wall_clock_s": row["wall_clock_s"], "cost": row.get("cost")}
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        return {}  # a sum of what is known must not end a training
