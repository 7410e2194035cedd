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


@pytest.fixture(params=[200])
def webhook(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Webhook]:
    """A webhook whose address the environment holds."""
    webhook = Webhook(request.param)
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
    send(tmp_path, "80 % of budget.minutes used", f"budget.alert_command='{command} alert'")
    assert (tmp_path / "sent").read_text() == f"alert: 80 % of budget.minutes used in {tmp_path}"


def test_a_webhook_gets_the_message(tmp_path, webhook):
    send(tmp_path, "50 % used", f"budget.alert_webhook={VARIABLE}")
    assert webhook.posted == [{"text": "50 % used", "content": "50 % used"}]


@pytest.mark.parametrize("webhook", [404], indirect=True)
def test_a_webhook_that_refuses_is_logged_without_its_address(tmp_path, webhook, caplog):
    caplog.set_level(logging.INFO)
    send(tmp_path, "50 % used", f"budget.alert_webhook={VARIABLE}")
    assert "budget.alert_webhook answered 404" in caplog.text
    assert "secret-path" not in caplog.text


def test_a_webhook_that_is_down_is_logged_without_its_address(tmp_path, webhook, caplog):
    caplog.set_level(logging.INFO)
    webhook.server.shutdown()
    webhook.server.server_close()
    send(tmp_path, "50 % used", f"budget.alert_webhook={VARIABLE}")
    assert "budget.alert_webhook cannot be reached" in caplog.text
    assert "secret-path" not in caplog.text


def test_a_command_that_fails_is_logged_with_its_last_line(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    command = script(tmp_path, "echo no such phone >&2; exit 7")
    send(tmp_path, "50 % used", f"budget.alert_command={command}")
    assert "budget.alert_command ended with exit code 7: no such phone" in caplog.text


def test_a_command_that_is_not_there_is_logged(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    send(tmp_path, "50 % used", "budget.alert_command=no-such-program")
    assert "budget.alert_command cannot be run: No such file" in caplog.text


def test_a_command_whose_quotes_do_not_close_is_refused(tmp_path):
    with pytest.raises(BadInput, match=r"budget\.alert_command=say 'it: No closing quotation"):
        send(tmp_path, "50 % used", 'budget.alert_command="say \'it"')


def test_without_command_and_webhook_nothing_is_sent(tmp_path):
    send(tmp_path, "50 % used")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("address", [None, "hooks.example.com/x", "file:///etc/passwd"])
def test_a_webhook_whose_variable_holds_no_address_is_refused(tmp_path, monkeypatch, address):
    if address is None:
        monkeypatch.delenv(VARIABLE, raising=False)
    else:
        monkeypatch.setenv(VARIABLE, address)
    with pytest.raises(BadInput, match=f"budget.alert_webhook={VARIABLE}: ") as refusal:
        send(tmp_path, "50 % used", f"budget.alert_webhook={VARIABLE}")
    assert address is None or address not in str(refusal.value)
