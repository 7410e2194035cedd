"""The folder that tells everything about a run."""

import datetime
import json
import platform
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil

from deepracer_exp.config.compose import Composition
from deepracer_exp.env.reward_source import RewardSource, source_with_constants
from deepracer_exp.errors import BadInput
from deepracer_exp.tracking.store import redact

from .files import write_whole

_PACKAGES = ("deepracer-exp", "torch", "torchrl", "tensordict", "mujoco", "hydra-core", "mlflow", "numpy")


class RunFolder:
    """`runs_dir/<experiment>/<run>/` and the files that lie directly in it."""

    def __init__(self, runs_dir: str, experiment: str, label: str):
        """Create a folder of its own, named by the time and `label`.

        Raises:
            BadInput: the folder cannot be created.
        """
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        name = f"{stamp}-{re.sub(r'[^A-Za-z0-9._-]+', '_', label)}"
        parent = Path(runs_dir) / experiment
        try:
            parent.mkdir(parents=True, exist_ok=True)
            self.path = _make_new(parent, name)
        except OSError as error:
            raise BadInput(
                f"runs_dir={runs_dir}: cannot create {parent / name}: {error.strerror}; give a folder that can be "
                "written"
            ) from error
        self.name = self.path.name
        self._metrics = self.path / "metrics.jsonl"

    def describe(self, composition: Composition, reward: RewardSource, seed: int) -> str | None:
        """Write the configuration and where code and reward come from; return the git commit if there is one."""
        self.write("config.yaml", redact(composition.yaml()))
        overrides = "".join(f"- {json.dumps(override)}\n" for override in composition.overrides)
        self.write("overrides.yaml", redact(overrides) or "[]\n")
        self.write("reward_function.py", source_with_constants(reward))
        commit = git_commit()
        provenance = {
            "versions": {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES},
            "git_commit": commit,
            "seed": seed,
            "machine": {
                "system": platform.platform(),
                "cores": psutil.cpu_count(),
                "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
            },
            "reward": {"name": reward.name, "path": str(reward.path), "sha256": reward.sha256},
            "command": [redact(argument) for argument in sys.argv[1:]],
        }
        self.write("provenance.json", json.dumps(provenance, indent=2) + "\n")
        return commit

    def append_metrics(self, row: dict[str, Any]) -> None:
        """Add one line to metrics.jsonl."""
        with self._metrics.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def write(self, name: str, text: str) -> Path:
        """Write a file whole or not at all."""
        return write_whole(self.path / name, text)

    def remove(self) -> None:
        """Take back a folder in which no run has begun."""
        shutil.rmtree(self.path, ignore_errors=True)


def git_commit() -> str | None:
    """Return the commit of the checkout this code runs from, `-dirty` if changed, None outside a checkout."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    try:
        commit = _git(root, "rev-parse", "HEAD")
        return f"{commit}-dirty" if _git(root, "status", "--porcelain") else commit
    except (OSError, subprocess.CalledProcessError):
        # No git, a checkout without a commit, or one owned by somebody else.
        return None


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def _make_new(parent: Path, name: str) -> Path:
    """Make a folder that was not there: two runs may start in the same second."""
    attempt = 1
    while True:
        path = parent / (name if attempt == 1 else f"{name}-{attempt}")
        try:
            path.mkdir()
        except FileExistsError:
            attempt += 1
        else:
            return path
