"""Pooled connections to a study's server, which are closed when nothing has used them for a while.

A new connection costs PostgreSQL a process and a password check, far more than the row that a transaction changes. But
a worker asks in bursts, when a trial begins and when it ends, and trains for minutes in between: connections that it
kept would be hundreds in a sweep of hundreds of workers, and PostgreSQL has 100 by default.
"""

import threading
import time
from typing import Any

import sqlalchemy as sa

IDLE_S = 2.0
"""Seconds without use after which connections are closed."""
_OLDEST_S = 300
"""Age of a connection at which the next transaction opens another one. One that was open while its machine slept may
seem alive for half a minute."""

POOL: dict[str, Any] = {
    # A broken connection, as after a restart of the server, is replaced before it is used.
    "pool_pre_ping": True,
    "pool_recycle": _OLDEST_S,
    # What a worker needs; more are closed when they are returned.
    "pool_size": 1,
    "max_overflow": 8,
    "pool_use_lifo": True,
}
"""Arguments of SQLAlchemy's `create_engine`."""


def close_when_idle(engine: sa.Engine, idle_s: float = IDLE_S) -> None:
    """Close the connections of an engine's pool whenever none has been used for `idle_s` seconds.

    A thread waits for that while connections are open, and ends with them. A forked process leaves the connections
    that it inherits alone: psycopg closes only those that the same process has opened.
    """
    lock = threading.Lock()
    used_at = 0.0
    is_watched = False

    def note_use(*_: object) -> None:
        nonlocal used_at, is_watched
        with lock:
            used_at = time.monotonic()
            if is_watched:
                return
            is_watched = True
        threading.Thread(target=watch, name="idle-connections", daemon=True).start()

    def watch() -> None:
        nonlocal is_watched
        while True:
            with lock:
                left_s = used_at + idle_s - time.monotonic()
                if left_s <= 0.0:
                    is_watched = False
                    break
            time.sleep(left_s)
        # Those in use at this moment are closed when they are returned.
        engine.dispose()

    sa.event.listen(engine, "checkout", note_use)
    sa.event.listen(engine, "checkin", note_use)
    note_use()
