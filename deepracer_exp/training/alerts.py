"""Alerts of a budget, sent to a command and to a webhook beside the training."""

import json
import logging
import os
import shlex
import subprocess
import threading
import urllib.error
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

from deepracer_exp.config.budget import BudgetConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.lifeline import running

_log = logging.getLogger(__name__)

_PATIENCE_S = 20.0


class Alerts:
    """Tells a command and a webhook, where the budget names them; neither holds the training up."""

    def __init__(self, config: BudgetConfig):
        """Take the command apart and look the webhook's address up.

        Raises:
            BadInput: the command's quotes do not close, or the environment variable is not set or holds no address.
        """
        self._command = _command(config)
        self._address = _webhook_address(config)
        self._threads: list[threading.Thread] = []

    def send(self, message: str, run_dir: Path) -> None:
        """Send a message of a run; what goes wrong is logged."""
        for wanted, how in ((self._command, self._run), (self._address, self._post)):
            if wanted is not None:
                thread = threading.Thread(
                    target=how, args=(wanted, message, run_dir), name="alert", daemon=True
                )
                thread.start()
                self._threads.append(thread)

    def close(self) -> None:
        """Wait for what is still on its way, for a while."""
        for thread in self._threads:
            thread.join(_PATIENCE_S)

    def _run(self, command: tuple[str, ...], message: str, run_dir: Path) -> None:
        try:
            line, pipe = [*command, message, str(run_dir.resolve())], subprocess.PIPE
            with running(line, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe) as done:
                _, said = done.communicate(timeout=_PATIENCE_S)
        except OSError as error:
            _log.info("budget.alert_command cannot be run: %s", error.strerror or error)
            return
        except subprocess.TimeoutExpired:
            _log.info("budget.alert_command was ended after %.0f s", _PATIENCE_S)
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
            f"budget.alert_command={config.alert_command}: {error}; accepted: a program and its arguments"
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
