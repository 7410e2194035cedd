"""A run or a study that somebody else has made runs nothing of theirs and sends nothing to them."""

import json
import os
import shlex
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
import yaml

from deepracer_exp.config import acting
from deepracer_exp.config.compose import compose_entry, compose_experiment, trusted
from deepracer_exp.sweeps.queue.storage import open_storage
from deepracer_exp.sweeps.queue.study import load_study

from .conftest import OFTEN, THREE

TINY = ("experiment=tiny", "collector=in_process", "collector.threads=1", *OFTEN, *THREE)
EVIL = "from pathlib import Path\nPath({canary!r}).touch()\n\ndef reward_function(params):\n    return 1.0\n"
EVIL_CLASS = (
    "from pathlib import Path\nPath({canary!r}).touch()\nimport torch\nclass Net(torch.nn.Sequential): ...\n"
)
SWEEP = (
    *("sweep", "experiment=tiny", "tracking=off", "collector.threads=1", "budget.env_steps=1024"),
    *("episode.max_steps=60", "sweep.protocol=three_trials", "sweep.workers=1", "sweep.rerank=0"),
)


@pytest.fixture
def account(tmp_path_factory, monkeypatch):
    """Be another account from here on, one that has named nothing yet; return a function that does it again."""

    def change() -> None:
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("account")))
        monkeypatch.setattr(acting, "_named", {})

    change()
    return change


def new_command(monkeypatch) -> None:
    """Forget what was named in this process, as the end of a command does."""
    monkeypatch.setattr(acting, "_named", {})


@pytest.fixture
def listener():
    """Yield the address of a server and the requests it has got, each with its headers."""
    requests: list[dict[str, str]] = []

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            requests.append(dict(self.headers))
            self.send_error(500)

        do_POST = do_PUT = do_PATCH = do_GET  # noqa: N815

        def log_message(self, format: str, *args: object) -> None: ...

    server = HTTPServer(("127.0.0.1", 0), Answer)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", requests
    server.shutdown()
    server.server_close()


@pytest.fixture
def stranger(copied, account, listener, mlflow_here, monkeypatch):
    """Return the folder of a run whose owner has written into it what they would like to happen, and a canary."""
    run = copied(*OFTEN, *THREE)
    canary = run.parents[2] / "canary"
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["budget"] |= {"alert_command": f"touch {canary}", "alerts": [1, 50]}
    config["tracking"] = {"kind": "mlflow", "uri": listener[0]}
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    tracked = {"run_id": "0" * 32, "run_name": "r", "experiment": "e", "start_ms": 1, "store": listener[0]}
    (run / "tracking.json").write_text(json.dumps(tracked))
    monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "me")
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "secret")
    return run, canary


COMMANDS = {
    "clone": ("clone", "budget.iterations=1"),
    "resume": ("resume", "budget.iterations=4"),
    "deliver": ("resume",),
    "evaluate": ("evaluate", "evaluation.trials=1", "evaluation.laps=1", "evaluation.time_s=3"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_run_of_a_stranger_runs_no_command_and_sends_nothing_to_its_server(
    stranger, listener, call, command
):
    run, canary = stranger
    word, *changes = COMMANDS[command]
    ended = call(word, str(run), *changes)
    assert "Traceback" not in ended.stderr
    assert not canary.exists()
    assert listener[1] == []
    if command in ("clone", "resume"):
        assert ended.code == 0, ended.stderr
        for key in ("budget.alert_command", "tracking.uri"):
            assert f"{key}=" in ended.stderr
        assert "not taken over" in ended.stderr
        (made,) = (one for one in ended.folders if command == "resume" or one != run)
        config = yaml.safe_load((made / "config.yaml").read_text())
        assert config["budget"]["alert_command"] is None
        assert config["tracking"] == {"kind": "mlflow", "uri": None}


def test_what_is_named_now_is_taken_over(stranger, call):
    run, canary = stranger
    more = (f"budget.alert_command=touch {canary}", "tracking=off", "budget.iterations=1")
    ended = call("clone", str(run), *more)
    assert ended.code == 0, ended.stderr
    assert "not taken over" not in ended.stderr
    assert canary.exists()


@pytest.mark.parametrize("command", ["clone", "resume"])
def test_a_reward_function_of_a_stranger_is_not_run_until_it_is_named(stranger, call, command):
    run, canary = stranger
    evil = run / "evil.py"
    evil.write_text(EVIL.format(canary=str(canary)))
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["reward"] |= {"file": str(evil)}
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    call(command, str(run), "budget.iterations=4").assert_refused()
    assert not canary.exists()
    if command == "clone":
        ended = call("clone", str(run), "budget.iterations=1", f"reward.file={evil}")
        assert ended.code == 0, ended.stderr
        assert canary.exists()


@pytest.mark.processes
def test_a_run_of_ones_own_is_resumed_and_cloned_with_all_that_it_had(call, account, monkeypatch, tmp_path):
    (tmp_path / "mine.py").write_text(EVIL.format(canary=str(tmp_path / "first")))
    sent = tmp_path / "sent"
    own = (
        "reward.file=mine.py",
        f"budget.alert_command=touch {sent}",
        "budget.alerts=[50,90]",
        "tracking=off",
    )
    ended = call("train", *TINY, *own)
    assert ended.code == 0, ended.stderr
    run = ended.folder
    for command in ("resume", "clone"):
        sent.unlink()
        new_command(monkeypatch)
        # A copy elsewhere is the user's own as well: contents count, not places.
        ended = call(command, str(run), "budget.iterations=4")
        assert ended.code == 0, ended.stderr
        assert "not taken over" not in ended.stderr
        assert sent.exists()
    (tmp_path / "mine.py").write_text(EVIL.format(canary=str(tmp_path / "second")))
    new_command(monkeypatch)
    call("clone", str(run)).assert_refused("reward.file=mine.py", "changed since")
    assert not (tmp_path / "second").exists()


@pytest.mark.slow
def test_a_study_of_a_stranger_imports_nothing_and_ones_own_resumes(run_at, account, tmp_path):
    canary, sent = tmp_path / "canary", tmp_path / "sent"
    (tmp_path / "evilnet.py").write_text(EVIL_CLASS.format(canary=str(canary)))
    (tmp_path / "mynet.py").write_text(
        "import torch\n"
        "class Net(torch.nn.Sequential):\n"
        "    def __init__(self, i, o):\n"
        "        super().__init__(torch.nn.Linear(i, o))\n"
    )
    begun = run_at(
        tmp_path,
        *SWEEP,
        *("study=s", "network=mynet:Net", "algorithm.lr=1e-3,1e-4", "sweep.trials=1"),
        *(f"budget.alert_command=touch {sent}", "budget.alerts=[50]"),
    )
    assert begun.code == 0, begun.stderr
    sent.unlink()
    again = run_at(tmp_path, "sweep", "study=s", "sweep.trials=2", "sweep.workers=1")
    assert again.code == 0, again.stderr
    assert sent.exists()
    assert len(again.folders) == 2

    account()
    study = load_study("s", open_storage(None, tmp_path / "runs"))
    for key in ("overrides", "base"):
        changed = [line.replace("mynet", "evilnet") for line in study.user_attrs[key]]
        study.set_user_attr(key, changed)
    ended = run_at(tmp_path, "sweep", "study=s", "sweep.trials=3", "sweep.workers=1")
    ended.assert_refused("network.target=evilnet:Net", "imports no code by itself")
    assert not canary.exists()
    for key in ("overrides", "base"):
        changed = [line for line in study.user_attrs[key] if "evilnet" not in line]
        study.set_user_attr(key, changed)
    sent.unlink()
    ended = run_at(tmp_path, "sweep", "study=s", "sweep.trials=3", "sweep.workers=1")
    assert ended.code == 0, ended.stderr
    assert "budget.alert_command" in ended.stderr
    assert not sent.exists()


STORED = {
    "budget.alert_command=say": "budget.alert_command=say",
    "tracking.uri=http://evil:5000": "tracking.uri=http://evil:5000",
    "tracking=wandb": "tracking.project=",
    "sweep.storage=postgresql+psycopg://evil/studies": "sweep.storage=",
    "sweep/executor=ray": "sweep.executor.address=auto",
}


@pytest.mark.parametrize("override", STORED)
def test_what_a_study_stores_counts_once_its_user_has_named_the_same(account, override):
    def composed(stored: bool) -> tuple[dict, tuple[str, ...]]:
        entry = "sweep" if override.startswith("sweep") else "train"
        made = trusted(compose_entry(entry, [override]), stored=stored)
        return made.mapping, made.notes

    plain = compose_entry("sweep" if override.startswith("sweep") else "train", []).mapping
    left_out, (note,) = composed(stored=True)
    assert STORED[override] in note
    assert left_out == plain
    named, _ = composed(stored=False)
    assert named != plain
    assert composed(stored=True) == (named, ())
    acting.remember()
    acting._named.clear()
    assert composed(stored=True) == (named, ())
    account()
    assert composed(stored=True)[0] == plain


@pytest.mark.parametrize("entity", [(), ("tracking.entity=team",)])
def test_the_words_that_choose_a_foreign_project_are_accepted_as_they_stand(account, entity):
    chosen = ("tracking=wandb", "tracking.project=season", *entity)
    *_, (note,) = (trusted(compose_entry("train", chosen), stored=True).notes,)
    words = shlex.split(note.partition("to use it, give ")[2])
    assert words == list(chosen)
    assert trusted(compose_entry("train", words), stored=False).mapping["tracking"]["kind"] == "wandb"
    assert trusted(compose_entry("train", chosen), stored=True).notes == ()


@pytest.mark.processes
def test_the_record_of_an_account_holds_no_text_and_is_its_own(call, account, tmp_path):
    ended = call("train", *TINY, "tracking=off", "budget.alert_command=true SECRET_TOKEN")
    assert ended.code == 0, ended.stderr
    (file,) = Path(os.environ["XDG_STATE_HOME"]).rglob("named/*")
    assert file.read_bytes() == b""
    assert file.stat().st_mode & 0o077 == 0
    assert "SECRET" not in file.name


def test_a_file_that_is_missing_or_endless_marks_nothing(account, tmp_path):
    compose_experiment(["reward.name=progress"])
    for file in ("/dev/zero", str(tmp_path / "gone.py"), str(tmp_path)):
        assert acting.reward_file(file).mark != acting.reward_file("/dev/null").mark
