"""log.txt of a run."""

import contextlib
import logging
from pathlib import Path


def log_to(path: Path) -> logging.FileHandler:
    """Write what the project logs to a file as well; remove the handler from the logger `deepracer_exp` at the end."""
    handler = _LogFile(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logger = logging.getLogger("deepracer_exp")
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    return handler


class _LogFile(logging.FileHandler):
    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - the base class's name
        """Say nothing: the run's end tells of a full disk, in one line."""

    def close(self) -> None:
        """Close the file; what a full disk does not take is lost."""
        with contextlib.suppress(OSError):
            super().close()
