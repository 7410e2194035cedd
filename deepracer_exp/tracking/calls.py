"""Calls to an MLflow store, each with a time limit and one-sentence errors."""

import logging
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

from deepracer_exp.addresses import redact
from deepracer_exp.patience import ends, wait_patiently

Value = TypeVar("Value")

CALL_S = 120.0
"""Longest wait for one call, which may send a checkpoint.

An HTTP timeout only limits the pause between two bytes: a server that trickles them could hold a call for ever."""
LISTING_S = 300.0
"""Longest wait for all pages of a listing together: a server could give one a minute for ever."""
_SAY_AFTER_S = 10.0
_log = logging.getLogger(__name__)
_WORTH_RETRYING = (408, 425, 429)


class StoreUnavailableError(Exception):
    """The store did not answer, or not as expected: the call may be repeated."""


class StoreRefusedError(Exception):
    """The store refused the call: repeating it would change nothing."""


class BoundedClient:
    """A client of MLflow whose calls all have a time limit.

    Its methods raise TimeoutError, which is an OSError, when their time is up.
    """

    def __init__(self, client: Any) -> None:
        self._client = client

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._client, name)
        if not callable(attribute):
            return attribute
        return partial(self._call, attribute)

    def _call(self, call: Callable[..., Any], *args: Any, **options: Any) -> Any:
        return ended_within(CALL_S, lambda: call(*args, **options))


def ended_within(seconds: float, call: Callable[[], Value]) -> Value:
    """Return the result of a call; when time is up, its thread is abandoned, since a thread cannot be killed.

    While this process or one that it has started computes, its CPU time is what counts (`wait_patiently`).

    Raises:
        TimeoutError: time is up.
    """
    results: list[Value] = []
    errors: list[BaseException] = []

    def work() -> None:
        try:
            results.append(call())
        except BaseException as error:  # noqa: BLE001 - raised again below
            errors.append(error)

    # Daemon, so that the process does not wait for it either.
    thread = threading.Thread(target=work, name="mlflow-call", daemon=True)
    thread.start()
    first_s = min(_SAY_AFTER_S, seconds)
    if wait_patiently(ends(thread), first_s) and first_s < seconds:
        _log.warning("MLflow has not answered for %g s; it is waited for up to %.0f s", first_s, seconds)
        wait_patiently(ends(thread), seconds - first_s)
    if errors:
        raise errors[0]
    if not results:
        raise TimeoutError(f"no answer within {seconds:.0f} s")
    return results[0]


@contextmanager
def store_errors() -> Iterator[None]:
    """Turn errors of MLflow and its database into StoreUnavailableError and StoreRefusedError, one sentence each."""
    from google.protobuf.json_format import ParseError  # type: ignore[import-untyped]
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except MlflowException as error:
        status = error.get_http_status_code()
        if 400 <= status < 500 and status not in _WORTH_RETRYING:
            raise StoreRefusedError(_sentence(error)) from error
        raise StoreUnavailableError(_sentence(error)) from error
    except FileNotFoundError as error:
        raise StoreRefusedError(str(error)) from error
    except (OSError, SQLAlchemyError, ParseError) as error:
        raise StoreUnavailableError(_sentence(error)) from error


def _sentence(error: BaseException) -> str:
    """Return an error of MLflow or its database as one sentence without passwords."""
    from google.protobuf.json_format import ParseError
    from mlflow.environment_variables import MLFLOW_HTTP_REQUEST_TIMEOUT
    from mlflow.exceptions import MlflowException, RestException
    from urllib3.exceptions import NewConnectionError, ProtocolError
    from urllib3.exceptions import TimeoutError as TooLate

    links = list(_causes(error))
    text = " ".join(str(error).split())
    failed = re.search(r"too many (\d{3}) error responses|failed with error code (\d{3})", text)
    status = int(failed[1] or failed[2]) if failed else None
    if any(
        isinstance(link, NewConnectionError | ProtocolError) for link in links
    ):  # the first is a TimeoutError, too
        return "no connection: nothing answers at this address"
    if any(isinstance(link, TooLate) for link in links):
        return f"no answer within {MLFLOW_HTTP_REQUEST_TIMEOUT.get()} s"
    if isinstance(error, MlflowException) and error.error_code == "UNAUTHENTICATED":
        return (
            "the server refuses the user and password (401); give them as MLFLOW_TRACKING_USERNAME and "
            "MLFLOW_TRACKING_PASSWORD"
        )
    if status is not None:
        return f"the server answers with error {status}{_server_text(text)}"
    if isinstance(error, ParseError) or ("valid JSON" in text and not isinstance(error, RestException)):
        return "the answer is not that of an MLflow server"
    return redacted_line(getattr(error, "orig", None) or error)


def _server_text(text: str) -> str:
    """Extract the server's own text, beside its error code, from MLflow's message; it may be a page."""
    quoted = re.search(r"Response body: '(.*)'", text)
    words = re.sub(r"<[^>]*>", " ", quoted[1]) if quoted else ""
    # Control characters would reach the terminal.
    shown = "".join(character if character.isprintable() else " " for character in words)
    return f": {redact(' '.join(shown.split())[:200])}" if shown.strip() else ""


def redacted_line(error: BaseException) -> str:
    """Return an error of a database on one line, shortened and without passwords."""
    return redact(" ".join(str(error).split()))[:300]


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Return an error and its causes; urllib3 keeps some as `reason`."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def run_if_there(client: Any, run_id: str) -> Any:
    """Return a run of MLflow, None if the store does not know it.

    Raises:
        MlflowException: any other error; translated by `store_errors`.
    """
    from mlflow.exceptions import MlflowException

    try:
        return client.get_run(run_id)
    except MlflowException as error:
        if error.error_code != "RESOURCE_DOES_NOT_EXIST":
            raise
        return None


def pages(search: Callable[..., Any], **what: Any) -> Iterator[Any]:
    """Return the results of one of the client's searches, from all pages.

    Raises:
        TimeoutError: they took too long together.
    """
    token, end_by = None, time.monotonic() + LISTING_S
    while True:
        if token and time.monotonic() > end_by:
            raise TimeoutError(f"its list has no end after {LISTING_S:.0f} s")
        page = search(**what, page_token=token)
        yield from page
        token = page.token
        if not token:
            return
