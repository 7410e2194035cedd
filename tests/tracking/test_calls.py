"""Servers that answer with an error, with something else, slowly or never."""

from collections.abc import Callable, Iterator
from functools import partialmethod

import pytest
from mlflow.environment_variables import MLFLOW_HTTP_REQUEST_TIMEOUT
from mlflow.store.entities import PagedList

from deepracer_exp.tracking import calls
from deepracer_exp.tracking.registry import look_up
from deepracer_exp.tracking.store import resolve_store
from deepracer_exp.tracking.tracker import ProjectedTracker
from tests.conftest import refused
from tests.waiting import wait_until

from .conftest import TrackerHere, begin, write_rows
from .odd_servers import odd_server

ODD = {
    "401": "refuses the user and password (401)",
    "403": "answers with error 403: Invalid Host header",
    "500": "answers with error 500",
    "302": "answers with error 302",
    "hang": "no answer within",
    "drip": "no answer within",
    "<html>": "not that of an MLflow server",
    '{"registered_models": [{"name": 3}], "experiment": 7}': "not that of an MLflow server",
    "closed": "nothing answers at this address",
}


@pytest.fixture(params=ODD)
def odd(request, free_port, monkeypatch) -> Iterator[tuple[str, str]]:
    """Address of an odd server, and what is said of it."""
    if request.param in ("hang", "drip"):
        monkeypatch.setattr(calls, "CALL_S", 0.02)
    if request.param == "closed":
        yield f"http://127.0.0.1:{free_port}", ODD["closed"]
        return
    with odd_server(request.param) as uri:
        yield uri, ODD[request.param]


def test_looking_up_an_alias_ends_in_one_sentence(odd, tmp_path):
    uri, words = odd
    message = refused(look_up, "x@champion", uri, tmp_path)
    assert message.startswith(f"x@champion: MLflow ({uri}): ")
    assert words in message
    assert len(message) < 220
    assert "API request" not in message


def test_a_run_that_is_not_recorded_says_so_and_why(odd, tmp_path):
    uri, words = odd
    tracker = TrackerHere(resolve_store(uri, tmp_path))
    begin(tracker, tmp_path, params={"seed": "1"})
    write_rows(tmp_path, [{"completion": 5.0}])
    wait_until(lambda: tracker.outage, "outage")
    # A limit of CPU time, of which attempts in this process use little.
    tracker.finish("FINISHED", deadline_s=0.05)
    assert tracker.failure is not None
    assert tracker.failure.startswith(f"MLflow ({uri}): some of this run was not recorded: ")
    assert words in tracker.failure


def test_a_person_who_waits_is_told_so(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(calls, "CALL_S", 0.6)
    monkeypatch.setattr(calls, "_SAY_AFTER_S", 0.1)
    with odd_server("hang") as uri:
        assert "no answer within 1 s" in refused(look_up, "x@champion", uri, tmp_path)
    assert "MLflow has not answered for 0.1 s; it is waited for up to 1 s" in caplog.text


def test_a_command_has_the_patience_of_mlflow_s_own_client(monkeypatch):
    monkeypatch.delenv("MLFLOW_HTTP_REQUEST_TIMEOUT", raising=False)
    assert MLFLOW_HTTP_REQUEST_TIMEOUT.get() == calls.CALL_S


@pytest.mark.slow
@pytest.mark.parametrize("answer", ["401", "500", "drip"])
def test_what_a_training_could_not_record_is_its_last_lines_and_is_sent_by_their_command(
    answer, tmp_path, call: Callable, train_here: Callable, server, monkeypatch
):
    monkeypatch.setattr(ProjectedTracker, "finish", partialmethod(ProjectedTracker.finish, deadline_s=10.0))
    with odd_server(answer) as uri:
        ended = train_here("tracking=mlflow", f"tracking.uri={uri}")
    assert ended.code == 0
    assert "compare runs" not in ended.stdout
    *_, warning, command = ended.stderr.splitlines()
    assert warning.startswith(f"warning: MLflow ({uri}): ")
    assert ODD[answer] in warning
    name = f"{ended.folder.parent.name}/{ended.folder.name}"
    *_, word, store = command.split(" ")
    assert word == f"runs/{name}"
    assert store == f"tracking.uri={uri}"
    # The server is mended, at another port here.
    sent = call("runs", "send", word, f"tracking.uri={server.uri}")
    assert sent.code == 0, sent.stderr
    assert sent.stdout.startswith(f"{name}: sent, with ")


def test_a_list_without_an_end_is_given_up(monkeypatch):
    monkeypatch.setattr(calls, "LISTING_S", 0.0)
    endless = PagedList(["a run"], token="more")
    with pytest.raises(TimeoutError, match="its list has no end"):
        list(calls.pages(lambda page_token: endless))
