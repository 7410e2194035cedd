"""The files a training leaves in its run folder, read back."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from deepracer_exp.errors import BadInput


@dataclass(frozen=True)
class RunRecord:
    """What a run's files tell."""

    path: Path
    config: dict[str, Any]
    """All values of the experiment, by group."""
    rows: list[dict[str, Any]]
    """metrics.jsonl, a row an iteration."""
    summary: dict[str, Any]
    """Empty for a run that goes on or was killed."""
    provenance: dict[str, Any]
    """Where code and reward come from."""

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.name


def read_run(path: Path) -> RunRecord:
    """Read a run's folder.

    Raises:
        BadInput: a file is missing, cannot be read or does not hold what a training writes.
    """
    config = _text(path / "config.yaml")
    try:
        mapping = yaml.safe_load(config)
    except yaml.YAMLError as error:
        raise BadInput(
            f"{path / 'config.yaml'}: is not valid YAML: {' '.join(str(error).split())}"
        ) from error
    if not isinstance(mapping, dict):
        raise BadInput(f"{path / 'config.yaml'}: holds no values; a run writes its experiment there")
    summary, provenance = (path / name for name in ("summary.json", "provenance.json"))
    return RunRecord(
        path,
        {str(key): value for key, value in mapping.items()},
        read_metrics(path / "metrics.jsonl"),
        _object(summary, _text(summary)) if summary.exists() else {},
        _object(provenance, _text(provenance)) if provenance.exists() else {},
    )


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Read metrics.jsonl; a last line without an end, cut off by a kill, is left out.

    Raises:
        BadInput: the file cannot be read, or a line is no JSON object.
    """
    lines = _text(path).split("\n")
    return [_object(path, line, f" line {number}") for number, line in enumerate(lines[:-1], 1)]


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: is not UTF-8 text") from error


def _object(path: Path, text: str, where: str = "") -> dict[str, Any]:
    try:
        value = json.loads(text)
    except ValueError as error:
        raise BadInput(f"{path}{where}: is not valid JSON: {error}") from error
    if not isinstance(value, dict):
        raise BadInput(f"{path}{where}: {text[:40]!r} is no JSON object")
    return value
