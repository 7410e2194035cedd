import logging
from pathlib import Path

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.training.budget import Alerts

pytestmark = pytest.mark.processes


def send(run_dir: Path, message: str, *overrides: str) -> None:
    alerts = Alerts(compose_experiment(list(overrides))[0].budget)
    alerts.send(message, run_dir)
    alerts.close()


def script(folder: Path, line: str) -> str:
    """Return the command of a script of one line; programs may not lie in a temporary folder everywhere."""
    (folder / "alert.sh").write_text(f"{line}\n")
    return f"sh {folder}/alert.sh"


def test_a_command_gets_the_message_and_the_runs_folder(tmp_path):
    command = script(tmp_path, f'printf "%s: %s in %s" "$@" > {tmp_path}/sent')
    send(tmp_path, "80% of budget.minutes used", f"budget.alert_command='{command} alert'")
    assert (tmp_path / "sent").read_text() == f"alert: 80% of budget.minutes used in {tmp_path}"


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("sh alert.sh", "budget.alert_command ended with exit code 7: no such phone"),
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
