"""Passwords of servers and databases, looked for in whatever a training and a sweep print and write."""

import base64
import http.server
import json
import subprocess
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import quote, quote_plus

import pytest
import sqlalchemy as sa
from hypothesis import given
from hypothesis import strategies as st
from mlflow import MlflowClient

from deepracer_exp.addresses import redact, with_password, without_passwords
from deepracer_exp.tracking.store import resolve_store

secret = st.text("abcXYZ0123%:!$/@", min_size=3).map(lambda text: f"s3cr3t{text}")


@given(secret, st.sampled_from(["http://me:{}@host:5000/x", "postgresql://me:{}@host/db", "https://{}@h"]))
def test_no_password_of_an_address_is_shown_and_each_is_known_again(password, address):
    address = address.format(quote(password, safe=""))
    for typed in (address, f"tracking.uri='{address}'", f"[{address}, {address}]"):
        plain = without_passwords(typed)
        assert "s3cr3t" not in plain
        assert without_passwords(plain) == plain
    assert with_password(without_passwords(address)) == address
    assert "s3cr3t" not in redact(f"call of {address} failed: {password}")


@pytest.mark.parametrize(
    ("address", "plain"),
    [
        ("http://host:5000/a@b", "http://host:5000/a@b"),
        ("http://me:s3cr/t@host:5000", "http://host:5000"),
        ("postgresql+psycopg://you@host/db", "postgresql+psycopg://you@host/db"),
        ("postgresql+psycopg://me:s3cr3t word@host/db", "postgresql+psycopg://me@host/db"),
        ("postgresql:///db?user=me&password=s3cr3t&host=/run/pg", "postgresql:///db?user=me&host=/run/pg"),
        ("postgresql:///db?password=s3cr3t", "postgresql:///db"),
        ("sqlite:////path/with@sign/mlflow.db", "sqlite:////path/with@sign/mlflow.db"),
    ],
)
def test_an_address_without_its_password_is_still_one(address, plain):
    assert without_passwords(address) == plain
    assert with_password(plain) == address


def test_a_store_is_shown_without_password(tmp_path):
    store = resolve_store("postgresql:///db?user=me&password=s3cr3t&host=/run/pg", tmp_path)
    assert "s3cr3t" in store.uri
    assert "s3cr3t" not in f"{store} {store!r} {store.shown}"
    server = resolve_store("http://me:s3cr%2F3t@host:5000", tmp_path)
    assert (server.uri, server.user, server.password) == ("http://host:5000", "me", "s3cr/3t")
    assert "s3cr" not in repr(server)


PASSWORD = "s3cr/t@{0}%25 word"
USER = "racer+1"
TINY = (
    *("experiment=tiny", "collector=in_process", "collector.threads=1", "checkpoints.every=1"),
    *("episode.max_steps=60", "budget.env_steps=null", "budget.iterations=2", "debug=true"),
)


@contextmanager
def guarded(uri: str) -> Iterator[str]:
    """Put an MLflow server behind a user and a password; yield the address with both."""
    right = "Basic " + base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()

    class Guard(http.server.BaseHTTPRequestHandler):
        def _pass_on(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            if self.headers.get("Authorization") != right:
                self._answer(401, b"who are you?")
                return
            request = urllib.request.Request(uri + self.path, body or None, method=self.command)
            request.add_header("Content-Type", self.headers.get("Content-Type", "application/json"))
            try:
                with urllib.request.urlopen(request) as answer:
                    self._answer(answer.status, answer.read())
            except urllib.error.HTTPError as error:
                self._answer(error.code, error.read())

        do_GET = do_POST = do_PUT = do_PATCH = do_DELETE = _pass_on  # noqa: N815 - names that http.server looks for

        def _answer(self, code: int, body: bytes) -> None:
            self.send_response(code)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    guard = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Guard)
    threading.Thread(target=guard.serve_forever, daemon=True).start()
    try:
        yield f"http://{quote(USER)}:{quote(PASSWORD, safe='')}@127.0.0.1:{guard.server_port}"
    finally:
        guard.shutdown()
        guard.server_close()


def all_rows(url: str) -> str:
    """Return everything that stands in a database."""
    engine = sa.create_engine(url, poolclass=sa.NullPool)
    with engine.connect() as connection:
        names = sa.inspect(engine).get_table_names()
        return repr([connection.execute(sa.text(f'SELECT * FROM "{name}"')).all() for name in names])


@pytest.mark.slow
def test_no_password_reaches_an_output_a_file_a_database_or_mlflow(
    server, postgres, start, call_at, tmp_path, monkeypatch
):
    assert postgres.password == PASSWORD
    monkeypatch.chdir(tmp_path)
    storage = postgres.new_database()
    said = []

    def run(code: int, *arguments: str, alone: bool = False) -> None:
        ended = start(*arguments).end() if alone else call_at(tmp_path, *arguments)
        assert ended.code == code, ended.stderr
        said.append(ended.stdout + ended.stderr)

    with guarded(server.uri) as uri:
        (tmp_path / "conf" / "tracking").mkdir(parents=True)
        own = tmp_path / "conf" / "tracking" / "mine.yaml"
        own.write_text(f"defaults: [mlflow]\nuri: {json.dumps(uri)}\n")
        run(0, "train", *TINY, "tracking=mine", "--cfg")
        run(0, "train", *TINY, "tracking=mine", "name=of_file")
        own.unlink()
        run(0, "train", *TINY, f"tracking.uri={uri}", "name=typed", alone=True)
        (trained,) = (tmp_path / "runs" / "typed").iterdir()
        assert (trained / "tracking.json").exists()
        run(2, "resume", str(trained), f"tracking.uri={uri}")
        run(0, "runs", "promote", str(trained), "checkpoint=last", f"tracking.uri={uri}")
        run(0, "ui", f"tracking.uri={uri}")
        sweep = ("sweep", *TINY, "study=mine", "algorithm.lr=1e-4,1e-3", "sweep.trials=2", "sweep.workers=1")
        sweep += ("sweep.protocol=three_trials", "sweep.rerank_laps=2", f"tracking.uri={uri}")
        run(0, *sweep, "--cfg", f"sweep.storage={storage}")
        run(0, *sweep, f"sweep.storage={storage}", alone=True)
        run(0, "sweep", "best", "mine", f"sweep.storage={storage}")
        run(2, "runs", "promote", str(trained), f"tracking.uri={uri.replace(quote(USER), 'somebody')}")
    run(2, "runs", "promote", str(trained), f"tracking.uri={uri}")  # which no server answers any more
    run(2, *sweep, f"sweep.storage={postgres.url('nowhere')}")
    run(2, *sweep, f"sweep.storage={storage.replace('+psycopg', '+nope')}")
    run(2, "train", *TINY, f"tracking.uri=ftp://me:{quote(PASSWORD, safe='')}@host")
    run(2, "train", *TINY, f"tracking.uri=http://me:{PASSWORD}@host")

    client = MlflowClient(tracking_uri=server.uri)
    kept = [client.get_experiment_by_name(name) for name in ("of_file", "typed", "mine")]
    runs = client.search_runs([one.experiment_id for one in kept])
    assert len(runs) == 5, "recorded anyway"
    stdouts = "\n".join(said)
    database = all_rows(storage)
    assert "algorithm.lr" in database
    wanted = {PASSWORD, quote(PASSWORD, safe=""), quote(PASSWORD, safe=" +"), quote_plus(PASSWORD), "s3cr"}
    (tmp_path / "server.db-dump").write_text(all_rows(f"sqlite:///{tmp_path}/server.db"))
    for spelling in wanted:
        assert spelling not in stdouts
        assert spelling not in database
    found = subprocess.run(["grep", "-rlaF", "s3cr", str(tmp_path)], capture_output=True, text=True)
    assert found.stdout == ""
