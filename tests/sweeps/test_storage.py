"""Storages of studies: opened by several processes at once, killed, stopped and started, and refused in one line."""

import random
import signal
import sqlite3
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import optuna
import pytest
import sqlalchemy as sa

from deepracer_exp.config.sweep import compose_sweep
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.sweeps.queue.claims import TrialClaims
from deepracer_exp.sweeps.queue.storage import open_storage, patiently, resolve_database
from deepracer_exp.sweeps.queue.study import load_study
from deepracer_exp.sweeps.trial import SeedRun
from tests.conftest import refused
from tests.waiting import PATIENCE_S

from .racer import make_trials

HOUR_S = 3600.0


@pytest.mark.parametrize("name", ["runs", "two words {0} 50%41 who?x=1 #1 läufe [a]*"])
def test_the_default_is_a_file_in_the_folder_of_the_runs_whatever_its_name(tmp_path, name):
    storage = open_storage(None, tmp_path / name)
    optuna.create_study(study_name="study", storage=storage)
    assert sorted(path.name for path in (tmp_path / name).iterdir() if path.suffix == ".db") == ["sweeps.db"]
    with sqlite3.connect(tmp_path / name / "sweeps.db") as connection:
        assert connection.execute("SELECT study_name FROM studies").fetchall() == [("study",)]
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_processes_that_start_together_share_one_study_and_number_each_trial_once(url, race):
    lines = race(make_trials, url, ("anna", "ben", "cleo"), 2).lines()
    assert sorted(int(line) for printed in lines for line in printed) == list(range(6))
    trials = optuna.load_study(study_name="study", storage=open_storage(url, Path())).trials
    assert [trial.number for trial in trials] == list(range(6))
    assert all(trial.state.name == "COMPLETE" for trial in trials)


def test_a_process_killed_while_it_makes_the_tables_leaves_nothing_in_the_way(url, race):
    racers = race(make_trials, url, ("anna", "ben"), 1)
    for number in (0, 1):
        time.sleep(random.uniform(0.0, 0.2))
        racers[number].kill()
    racers.lines()
    storage = open_storage(url, Path())
    study = optuna.create_study(study_name="study", storage=storage, load_if_exists=True)
    study.tell(study.ask(), 1.0)
    assert TrialClaims(storage.engine, "study").claim("next", 1, HOUR_S).trial.number == 0


@pytest.mark.parametrize(
    "missing",
    [
        "",
        "DELETE FROM alembic_version",
        "DELETE FROM version_info",
        "DROP TABLE trial_values",
        "DROP TABLE studies",
    ],
)
def test_a_file_that_a_killed_process_left_incomplete_is_completed(tmp_path, missing):
    file = tmp_path / "sweeps.db"
    if missing:
        open_storage(None, tmp_path)
        with sqlite3.connect(file) as connection:
            connection.executescript(f"{missing}; DROP TABLE IF EXISTS alembic_version")
    else:
        file.touch()
    study = optuna.create_study(study_name="study", storage=open_storage(None, tmp_path))
    study.tell(study.ask(), 1.0)
    assert optuna.load_study(study_name="study", storage=open_storage(None, tmp_path)).best_value == 1.0


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("postgresql//racer:s3cret@host/db", ["sweep.storage: not the URL of a database", "accepted: "]),
        ("postgresql://racer:s3cret@host:port/db", ["not the URL of a database"]),
        ("s3cret", ["not the URL of a database"]),
        ("postgres://racer:s3cret@host/db", ["did you mean postgresql?"]),
        ("oracle://racer:s3cret@host/db", ["not a kind of database that holds sweeps", "accepted: "]),
        ("postgresql+nope://racer:s3cret@host/db", ["no such driver"]),
        ("sqlite+aiosqlite:///x.db", ["asynchronous"]),
        ("mysql+pymysql://racer:s3cret@host/db", ["not a kind of database that holds sweeps"]),
        ("postgresql+pg8000://racer:s3cret@host/db", ["pip install 'pg8000'"]),
        ("postgresql://racer:s3cret@host", ["names no database"]),
        ("sqlite://", ["names no file"]),
        ("sqlite:///:memory:", ["names no file"]),
        ("sqlite:////proc/1/sweeps.db", ["/proc/1/sweeps.db"]),
        ("sqlite:////dev/null/sweeps.db", ["/dev/null"]),
        ("sqlite:////tmp", ["/tmp is a folder"]),
        ("postgresql://racer:s3cret@127.0.0.1:1/db", ["refused"]),
        ("postgresql://racer@127.0.0.1:1/db?password=s3cret", ["refused"]),
    ],
)
def test_an_impossible_address_is_refused_in_one_line_without_the_password(url, words, tmp_path):
    message = refused(open_storage, url, tmp_path)
    for word in words:
        assert word in message
    assert "s3cret" not in message
    assert message.startswith("sweep.storage")


def test_a_file_that_is_no_database_is_refused(tmp_path):
    (tmp_path / "sweeps.db").write_text("my notes, long enough to be looked at " * 100)
    assert "not a database" in refused(open_storage, None, tmp_path)
    assert (tmp_path / "sweeps.db").read_text().startswith("my notes")


def test_a_database_of_another_program_is_refused_and_left_as_it_is(url):
    engine = sa.create_engine(url)
    with engine.begin() as connection:
        connection.execute(sa.text("CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL)"))
        connection.execute(sa.text("INSERT INTO alembic_version VALUES ('1b5f0d9ad7c1')"))
    assert "a database of their own" in refused(open_storage, url, Path())
    assert sa.inspect(engine).get_table_names() == ["alembic_version"]
    engine.dispose()


@pytest.mark.parametrize("where", ["PGPASSWORD", "PGPASSFILE", "oc.env"])
def test_a_password_need_not_stand_on_the_command_line(postgres_server, where, monkeypatch, tmp_path):
    whole = postgres_server.new_database()
    address = sa.make_url(whole).set(password=None).render_as_string(hide_password=False)
    if where == "PGPASSWORD":
        monkeypatch.setenv("PGPASSWORD", postgres_server.password)
    elif where == "PGPASSFILE":  # or ~/.pgpass
        file = tmp_path / "pgpass"
        word = postgres_server.password.replace("\\", r"\\").replace(":", r"\:")
        file.write_text(f"127.0.0.1:*:*:racer:{word}\n")
        file.chmod(0o600)
        monkeypatch.setenv("PGPASSFILE", str(file))
    else:
        monkeypatch.setenv("STUDY_DB", whole)
        address = compose_sweep(["sweep.storage=${oc.env:STUDY_DB}"]).entry.sweep.storage
    assert postgres_server.password not in address
    optuna.create_study(study_name=where, storage=open_storage(address, Path()))


def test_no_password_is_shown_by_a_storage_nor_by_a_server_that_refuses(postgres_server):
    storage = open_storage(postgres_server.new_database(), Path())
    unknown = refused(load_study, "none", storage)
    assert "study none: not found in " in unknown
    assert "127.0.0.1" in unknown
    wrong = refused(open_storage, postgres_server.url(password="wr0ng/{p}@ss%"), Path())
    missing = refused(open_storage, postgres_server.url("nowhere"), Path())
    assert "password authentication failed" in wrong
    assert '"nowhere" does not exist' in missing
    database = resolve_database(postgres_server.url(), Path())
    for text in (repr(storage), str(storage), unknown, repr(database), wrong, missing):
        assert "s3cr" not in text
        assert "wr0ng" not in text


def test_transactions_share_a_connection(postgres_server):
    url = postgres_server.new_database()
    engine = sa.create_engine(url, **resolve_database(url, Path()).engine_options())
    opened = []
    sa.event.listen(engine, "connect", lambda *_: opened.append(1))
    claims = TrialClaims(engine, "study")
    claim = claims.claim("one", 1, HOUR_S)
    for _ in range(20):
        assert claims.renew(claim, HOUR_S)
    engine.dispose()
    assert len(opened) == 1


def test_a_connection_that_a_restart_of_the_server_broke_fails_no_call(postgres):
    storage = open_storage(postgres.new_database(), Path())
    study = optuna.create_study(study_name="study", storage=storage)
    claims = TrialClaims(storage.engine, "study")
    claim = claims.claim("one", 1, HOUR_S)
    postgres.stop()
    postgres.start()
    assert claims.renew(claim, HOUR_S)
    study.set_user_attr("trials", 1)


def test_a_stopped_process_holds_a_row_of_postgresql_for_a_minute_at_most(postgres_server):
    url = postgres_server.new_database()
    with open_storage(url, Path()).engine.connect() as connection:
        for setting in ("idle_in_transaction_session_timeout", "lock_timeout"):
            assert connection.execute(sa.text(f"SHOW {setting}")).scalar_one() == "1min"


@pytest.mark.parametrize("how", ["SIGINT", "SIGQUIT"])
def test_a_server_that_is_stopped_and_started_is_waited_for(postgres, how):
    storage = open_storage(url := postgres.new_database(), Path())
    study = optuna.create_study(study_name="study", storage=storage)
    claims = TrialClaims(storage.engine, "study")
    claim = claims.claim("one", 2, HOUR_S)
    trial = study.ask()
    postgres.stop(signal.Signals[how])
    calls = [
        lambda: claims.renew(claim, HOUR_S),
        lambda: claims.record(claim, [SeedRun(seed=0)]),
        lambda: study.tell(trial, 1.0, skip_if_finished=True).state.name,
        lambda: open_storage(url, Path(), patience_s=HOUR_S).get_n_trials(study._study_id),
    ]
    with ThreadPoolExecutor(len(calls)) as threads:
        waiting = [threads.submit(patiently, call, HOUR_S) for call in calls]
        time.sleep(0.5)
        assert not any(one.done() for one in waiting)
        postgres.start()
        assert [one.result(PATIENCE_S) for one in waiting] == [True, True, "COMPLETE", 1]
    assert claims.all()[0].trial.runs == (SeedRun(seed=0),)


def test_a_server_that_stays_away_ends_the_wait_in_one_line(postgres):
    claims = TrialClaims(open_storage(postgres.new_database(), Path()).engine, "study")
    postgres.stop()
    with pytest.raises(RunFailed, match=r"has not answered for 0\.3 s") as failed:
        patiently(claims.all, 0.3)
    assert "s3cr" not in str(failed.value)
    assert "\n" not in str(failed.value)
    with pytest.raises(BadInput, match="refused"):
        open_storage(postgres.url(), Path(), patience_s=0.3)


def test_a_locked_file_is_waited_for(tmp_path):
    url = f"sqlite:///{tmp_path}/sweeps.db"
    study = optuna.create_study(study_name="study", storage=open_storage(url, Path()))
    impatient = sa.create_engine(url, connect_args={"timeout": 0.0})
    claims = TrialClaims(impatient, "study")
    other = sqlite3.connect(tmp_path / "sweeps.db", isolation_level=None, check_same_thread=False)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(RunFailed, match="locked"):
        patiently(lambda: claims.claim("one", 1, HOUR_S), 0.0)
    end = threading.Timer(0.5, lambda: other.execute("COMMIT"))
    end.start()
    assert patiently(lambda: claims.claim("one", 1, HOUR_S), HOUR_S).trial.number == 0
    assert patiently(study.ask, HOUR_S).number == 0
    end.join()
    other.close()


def test_an_error_that_waiting_does_not_change_is_raised_at_once(tmp_path):
    storage = open_storage(None, tmp_path)
    claims = TrialClaims(storage.engine, "study")
    study = optuna.create_study(study_name="study", storage=storage)
    with storage.engine.begin() as connection:
        connection.execute(sa.text("DROP TABLE deepracer_trials"))
        connection.execute(sa.text("DROP TABLE trials"))
    for call in (claims.all, study.ask):
        with pytest.raises(RunFailed, match="cannot be used: no such table"):
            patiently(call, HOUR_S)
