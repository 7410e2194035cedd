"""Files in the working folder that have the names of installed modules: no process that we start imports them."""

import os
import signal
import sys
import urllib.request

import pytest

NAMES = (
    *("calendar", "queue", "selectors", "signal", "struct", "pickle", "random", "logging", "socket"),
    *("mlflow", "uvicorn", "fastapi", "sqlalchemy", "torch", "numpy", "tensordict", "torchrl", "psutil"),
)


@pytest.fixture
def canary(tmp_path):
    """Return the file in which each of these modules would write its name, if it were imported."""
    for name in NAMES:
        code = f"open({str(tmp_path / 'canary')!r}, 'a').write(__name__ + ' ')\nraise ImportError(__file__)\n"
        (tmp_path / f"{name}.py").write_text(code)
    return tmp_path / "canary"


@pytest.mark.slow
def test_neither_the_fork_server_nor_the_user_interface_imports_from_the_working_folder(
    start, canary, free_port
):
    trained = start(
        "train", "experiment=tiny", "collector=sync", "collector.processes=2", "budget.env_steps=2048"
    )
    ended = trained.end()
    assert ended.code == 0, ended.stderr
    ui = start("ui", "--port", str(free_port))
    ui.wait_for(lambda: "http://" in (ui.cwd / "stdout.txt").read_text(), "address")
    page = urllib.request.urlopen(
        f"http://127.0.0.1:{free_port}/api/2.0/mlflow/experiments/search?max_results=5"
    )
    assert b"tiny" in page.read()
    ui.popen.send_signal(signal.SIGTERM)
    ui.end()
    assert not canary.exists(), canary.read_text()


@pytest.mark.slow
def test_a_command_for_alerts_is_a_program_of_the_users_own_and_imports_beside_itself(start, tmp_path):
    (tmp_path / "helper.py").write_text("WORD = 'helped'\n")
    (tmp_path / "alert.py").write_text(
        "import pathlib, sys\nimport helper\npathlib.Path('alerted').write_text(helper.WORD)\n"
    )
    command = f"budget.alert_command={sys.executable} alert.py"
    ended = start("train", "experiment=tiny", "tracking=off", "collector=in_process", command).end()
    assert ended.code == 0, ended.stderr
    assert (tmp_path / "alerted").read_text() == "helped"
    assert "PYTHONSAFEPATH" not in os.environ
