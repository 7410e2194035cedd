"""The process that records runs: it reads their folders and brings trackers up to date.

A training must not wait for a tracker: MLflow takes two seconds to import, its calls are mostly Python, and its server
may be down, slow or come back later. So the training only writes its folder, and names the folder to this process
(`projector`), once when the run begins and once when it has ended. Then it waits until `mlflow.json` has that end.

Until a run has begun this process imports nothing else: the cores are for the start of the training.
"""

import json
import os
import queue
import random
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .projection import RunProjection

Lines = queue.SimpleQueue[dict[str, Any] | None]

_FIRST_PAUSE_S, _LONGEST_PAUSE_S, _LAST_PAUSE_S = 0.1, 10.0, 0.5
"""Pauses between two attempts while a server does not answer: the first, the longest, and the longest once the run has
ended and its owner waits."""
_LOOK_S = 0.1


def serve(lines: Lines) -> None:
    """Record the run of the newest line, until None comes; an empty line asks for another look at once.

    A line has the `folder` of the run, the `kind` and the `options` of its tracker, `every_s`, the pause between two
    updates of a server that answers, and `first`, a file after which recording begins, or null; it is not waited for
    longer than until the second update would be due.
    """
    projection: RunProjection | None = None
    every_s, retry_s = 0.0, _FIRST_PAUSE_S
    line = lines.get()
    while line is not None:
        if line:
            if projection is None and line["first"] is not None:
                newer = _begun(lines, Path(line["first"]), line["every_s"])
                if newer is None:
                    return
                line = newer or line
            projection, every_s, retry_s = _opened(line), line["every_s"], _FIRST_PAUSE_S
        assert projection is not None
        pause_s: float | None
        if _has_answered(projection):
            retry_s, pause_s = _FIRST_PAUSE_S, None if projection.is_done else every_s
        else:
            # Jitter, so that processes that began to wait together do not return together.
            longest_s = _LAST_PAUSE_S if projection.has_ended else _LONGEST_PAUSE_S
            pause_s = min(retry_s, longest_s) + random.uniform(0.0, 0.1)
            retry_s = min(2 * retry_s, _LONGEST_PAUSE_S)
        try:
            line = lines.get(timeout=pause_s)
        except queue.Empty:
            line = {}


def _begun(lines: Lines, first: Path, most_s: float) -> dict[str, Any] | None:
    """Wait until a run has begun; return the next line if that comes before, an empty one if not."""
    end = time.monotonic() + most_s
    while not first.exists() and time.monotonic() < end:
        try:
            return lines.get(timeout=_LOOK_S)
        except queue.Empty:
            pass
    return {}


def _opened(line: dict[str, Any]) -> "RunProjection":
    from deepracer_exp.addresses import take_over

    take_over(line["addresses"])
    folder, options = Path(line["folder"]), line["options"]
    if line["kind"] == "mlflow":
        from .projection import MLflowProjection
        from .store import Store

        return MLflowProjection(Store(**options), folder)
    from deepracer_exp.config.running import WandbTracking

    from .loggers import TensorBoardProjection, WandbProjection

    return (
        TensorBoardProjection(folder)
        if line["kind"] == "tensorboard"
        else WandbProjection(WandbTracking(**options), folder)
    )


def _has_answered(projection: "RunProjection") -> bool:
    """Bring a tracker up to date; return False if the server did not answer, so that it must be repeated."""
    from deepracer_exp.errors import BadInput

    from .calls import StoreUnavailableError, redacted_line

    try:
        projection.update()
    except StoreUnavailableError:
        return False
    except BadInput as error:
        projection.give_up(str(error))
    except Exception as error:  # noqa: BLE001 - noted, and shown at the end of the training
        projection.give_up(f"{type(error).__name__}: {redacted_line(error)}")
    return True


def _main() -> None:
    # Calls are repeated here; a command, whose user waits, has MLflow's own patience of 120 s.
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
    lines: Lines = queue.SimpleQueue()
    threading.Thread(target=_read, args=(lines,), daemon=True).start()
    serve(lines)


def _read(lines: Lines) -> None:
    for text in sys.stdin:
        lines.put(json.loads(text))
    os._exit(0)  # the owner has ended, even if a call still waits


if __name__ == "__main__":
    _main()
