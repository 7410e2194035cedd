"""Files that are never half there."""

import contextlib
from pathlib import Path


def write_whole(path: Path, text: str) -> Path:
    """Write a file whole or not at all."""
    aside = path.with_name(f".{path.name}.tmp")
    try:
        aside.write_text(text, encoding="utf-8")
        return aside.replace(path)
    except OSError:
        # A disk that takes no file may refuse to give one up as well.
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)
        raise
