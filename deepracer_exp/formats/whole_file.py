"""Files that are never half there."""

import contextlib
import uuid
from pathlib import Path


def write_whole(path: Path, text: str) -> Path:
    """Write a file whole or not at all; of several processes that write it at once, the last one has written it."""
    # Each in a file of its own: what another process moved into place would be missing here.
    aside = path.with_name(f".{uuid.uuid4().hex}.tmp")
    try:
        aside.write_text(text, encoding="utf-8")
        return aside.replace(path)
    except BaseException:
        # A disk that takes no file may refuse to give one up as well.
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)
        raise
