import http.server
import json
import logging
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.training.budget import Alerts

VARIABLE = "DEEPRACER_EXP_TEST_WEBHOOK"


class Webhook:
    """A web server that keeps what is posted to it."""

    def __init__(self, answer: int):
        self.posted: list[dict] = []
        webhook = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                webhook.posted.append(json.loads(body))
                self.send_response(answer)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Say nothing."""

        self.server = http.server.HTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self.server.server_port}/secret-path"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


@pytest.fixture
def webhook(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Webhook]:
    """A webhook whose address the environment holds; it answers with the parameter, or 200."""
    webhook = Webhook(getattr(request, "param", 200))
    monkeypatch.setenv(VARIABLE, webhook.address)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    yield webhook
    webhook.server.shutdown()


def send(run_dir: Path, message: str, *overrides: str) -> None:
    alerts = Alerts(compose_experiment(list(overrides))[0].budget)
    alerts.send(message, run_dir)
    alerts.close()


def script(folder: Path, line: str) -> Path:
    path = folder / "alert.sh"
    path.write_text(f"#!/bin/sh\n{line}\n")
    path.chmod(0o755)
    return path


def test_a_command_gets_the_message_and_the_runs_folder(tmp_path):
    command = script(tmp_path, f'printf "%s: %s in %s" "$@" > {tmp_path}/sent')
    send(tmp_path, "80% of budget.minutes used", f"budget.alert_command='{command} alert'")
    assert (tmp_path / "sent").read_text() == f"alert: 80% of budget.minutes used in {tmp_path}"


def test_a_webhook_gets_the_message(tmp_path, webhook):
    send(tmp_path, "50% used", f"budget.alert_webhook={VARIABLE}")
    assert webhook.posted == [{"text": "50% used", "content": "50% used"}]


@pytest.mark.parametrize(
    ("webhook", "is_down", "words"),
    [
        (404, False, "budget.alert_webhook answered 404"),
        (200, True, "budget.alert_webhook cannot be reached"),
    ],
    indirect=["webhook"],
)
def test_a_webhook_that_fails_is_logged_without_its_address(tmp_path, webhook, caplog, is_down, words):
    caplog.set_level(logging.INFO)
    if is_down:
        webhook.server.shutdown()
        webhook.server.server_close()
    send(tmp_path, "50% used", f"budget.alert_webhook={VARIABLE}")
    assert words in caplog.text
    assert "secret-path" not in caplog.text


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("./alert.sh", "budget.alert_command ended with exit code 7: no such phone"),
        ("no-such-program", "budget.alert_command cannot be run: No such file"),
    ],
)
def test_a_command_that_fails_is_logged_with_its_last_line(tmp_path, monkeypatch, caplog, command, words):
    caplog.set_level(logging.INFO)
    monkeypatch.chdir(tmp_path)
    script(tmp_path, "echo no such phone >&2; exit 7")
    send(tmp_path, "50% used", f"budget.alert_command={command}")
    assert words in caplog.text


def test_a_command_whose_quotes_do_not_close_is_refused(tmp_path):
    with pytest.raises(BadInput, match=r"budget\.alert_command=say 'it: No closing quotation"):
        send(tmp_path, "50% used", 'budget.alert_command="say \'it"')


@pytest.mark.parametrize("address", [None, "hooks.example.com/x", "file:///etc/passwd"])
def test_a_webhook_whose_variable_holds_no_address_is_refused(tmp_path, monkeypatch, address):
    if address is not None:
        monkeypatch.setenv(VARIABLE, address)
    with pytest.raises(BadInput, match=f"budget.alert_webhook={VARIABLE}: ") as refusal:
        send(tmp_path, "50% used", f"budget.alert_webhook={VARIABLE}")
    assert address is None or address not in str(refusal.value)
