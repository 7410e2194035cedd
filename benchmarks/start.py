"""Seconds from a command to its first control step and to its end, and the largest imports on the way.

    python -m benchmarks.start [--turns 5] [--before FOLDER] [--json FILE] [OVERRIDE...]

`deepracer-exp train experiment=tiny OVERRIDE...` runs in an empty folder, with a fork server and workers as usual:

- `first_step_s`: until a worker has made the first control step.
- `end_s`: until the command has ended.
- `cpu_s`: CPU seconds of the training process. On a busy machine these, not the others, compare.

and a sweep of one trial:

- `first_trial_s`: until the folder of the first trial's run is there, and the trial has begun.

Bytecode is there, as on a racer's machine: it is written, whatever the environment says, by a first run that is not
counted.

With `--before`, another checkout with its own .venv does the same in turns, and ratios come with their 95 per cent
bootstrap interval.

The imports are those of the training in one process (`python -X importtime`), by package: modules, seconds in them, and
when the first of them was imported. "later" are those that begin after the first iteration.
"""

import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from deepracer_exp.runs.run_files import CONFIG, HEARTBEAT, METRICS

from .report import benchmark_parser, number, table, write_json

LARGEST = 10
"""Packages that are printed."""
WANTED_S = {"first_step_s": 4.5, "end_s": 6.0, "first_trial_s": 5.0}
"""Medians to stay below on two quiet cores."""
_TRAINING = ("train", "experiment=tiny")
_SWEEP = (
    *("sweep", "experiment=tiny", "algorithm.lr=tag(log,interval(1e-4,1e-3))"),
    *("sweep.trials=1", "sweep.seeds=1", "sweep.workers=1", "sweep.rerank=0", "sweep.pruners=[]"),
)
ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
_LOOK_EVERY_S = 0.005
_RESAMPLES = 2000
_LINE = re.compile(r"import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)")
_FIRST_ITERATION = "iteration 1 "


@dataclass
class Package:
    """Imports of one package."""

    name: str
    began_s: float
    """Since the start of the command."""
    is_later: bool
    """Whether the first of its modules was imported after the first iteration."""
    modules: int = 0
    seconds: float = 0.0


def measure(python: Path, overrides: Sequence[str], folder: Path) -> dict[str, float]:
    """Train once and sweep once with the environment of a Python, in an empty folder."""
    stepped = run(python, _TRAINING, overrides, folder / "train", has_stepped)
    begun = run(python, _SWEEP, overrides, folder / "sweep", has_trial)
    return {
        "first_step_s": stepped["first_s"],
        "end_s": stepped["end_s"],
        "cpu_s": stepped["cpu_s"],
        "first_trial_s": begun["first_s"],
    }


def run(
    python: Path,
    arguments: Sequence[str],
    overrides: Sequence[str],
    folder: Path,
    has_begun: Callable[[Path], bool],
) -> dict[str, float]:
    """Run a command and return when something had begun, when it ended, and its CPU seconds.

    Raises:
        SystemExit: it failed, or ended without having begun.
    """
    folder.mkdir()
    line = [str(python.with_name("deepracer-exp")), *arguments, *overrides]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began, first_s = time.monotonic(), None
    with (folder / "output.txt").open("w") as output:
        process = subprocess.Popen(
            line,
            cwd=folder,
            env=ENVIRONMENT,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        while process.poll() is None:
            if first_s is None and has_begun(folder):
                first_s = time.monotonic() - began
            time.sleep(_LOOK_EVERY_S)
    end_s, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode or first_s is None:
        raise SystemExit(
            f"{' '.join(line)}: exit code {process.returncode}\n{(folder / 'output.txt').read_text()}"
        )
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"first_s": first_s, "end_s": end_s, "cpu_s": cpu_s}


def has_stepped(folder: Path) -> bool:
    """Return whether a worker of a training there has made a control step, by the file in which they count them.

    On a machine too busy to look in time, the first iteration's row says so later.
    """
    if any(folder.glob(f"runs/*/*/{METRICS}")):
        return True
    for file in folder.glob(f"runs/*/*/{HEARTBEAT}"):
        try:
            steps = np.fromfile(file, np.int64)
        except FileNotFoundError:  # the run has just ended
            continue
        if (steps > 0).any():
            return True
    return False


def has_trial(folder: Path) -> bool:
    """Return whether a run of a sweep there has begun."""
    return any(folder.glob(f"runs/*/*/{CONFIG}"))


def packages(python: Path, overrides: Sequence[str], folder: Path) -> list[Package]:
    """Train in one process and return what it imported, the package with the most seconds first."""
    line = [str(python), "-X", "importtime", str(python.with_name("deepracer-exp")), *_TRAINING]
    pipes: dict[str, Any] = {
        "env": ENVIRONMENT,
        "stdin": subprocess.DEVNULL,
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.PIPE,
    }
    with subprocess.Popen(
        [*line, "collector=in_process", *overrides], cwd=folder, text=True, **pipes
    ) as process:
        assert process.stderr is not None
        found = packages_of(process.stderr)
    if process.returncode:
        raise SystemExit(f"{' '.join(line)}: exit code {process.returncode}")
    return found


def packages_of(lines: Iterable[str]) -> list[Package]:
    """Return the packages that a training imports, the one with the most seconds first; the lines come as it runs."""
    found: dict[str, Package] = {}
    began, is_later = time.monotonic(), False
    for line in lines:
        is_later |= _FIRST_ITERATION in line
        if match := _LINE.match(line):
            name = match[2].partition(".")[0]
            package = found.setdefault(name, Package(name, time.monotonic() - began, is_later))
            package.modules += 1
            package.seconds += int(match[1]) / 1e6
    return sorted(found.values(), key=lambda package: -package.seconds)


def ratio(before: Sequence[float], now: Sequence[float]) -> dict[str, float]:
    """Return the ratio of two medians and the ends of its 95 per cent bootstrap interval."""
    rng = np.random.default_rng(0)
    drawn = [
        np.median(rng.choice(np.asarray(values), (_RESAMPLES, len(values))), axis=1)
        for values in (now, before)
    ]
    low, high = np.percentile(drawn[0] / drawn[1], (2.5, 97.5))
    return {"ratio": float(np.median(now) / np.median(before)), "low": float(low), "high": float(high)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("start", __doc__)
    parser.add_argument("--turns", type=int, default=5, help="runs of each")
    parser.add_argument(
        "--before", type=Path, help="another checkout, with its own .venv, to measure in turns"
    )
    options = parser.parse_args(arguments)
    pythons = {"now": Path(sys.executable)}
    if options.before is not None:
        pythons["before"] = options.before.absolute() / ".venv" / "bin" / "python"
    figures: dict[str, list[dict[str, float]]] = {name: [] for name in pythons}
    with tempfile.TemporaryDirectory() as place:
        for turn in range(options.turns + 1):
            for name, python in pythons.items():
                folder = Path(place, f"{name}{turn}")
                folder.mkdir()
                measured = measure(python, options.overrides, folder)
                if turn:  # the first one writes the bytecode
                    figures[name].append(measured)
        largest = packages(pythons["now"], options.overrides, Path(place))
    data: dict[str, Any] = {"turns": figures, "wanted": WANTED_S, "imports": [vars(each) for each in largest]}
    rows = []
    for key in figures["now"][0]:
        values = {name: [each[key] for each in taken] for name, taken in figures.items()}
        cells = [
            number(float(np.median(values[name])), 2) if name in values else "-" for name in ("before", "now")
        ]
        if "before" in values:
            data.setdefault("ratios", {})[key] = against = ratio(values["before"], values["now"])
            cells.append(f"{against['ratio']:.2f} [{against['low']:.2f}, {against['high']:.2f}]")
        else:
            cells.append("-")
        rows.append((key, *cells, number(WANTED_S.get(key), 1)))
    print(table(("", "before", "now", "ratio", "wanted, at most"), rows))
    imports = [
        (
            each.name,
            number(each.modules),
            number(each.seconds, 2),
            "later" if each.is_later else number(each.began_s, 1),
        )
        for each in largest[:LARGEST]
    ]
    print(f"\n{table(('package', 'modules', 'seconds', 'from (s)'), imports)}")
    write_json(options.json, data)


if __name__ == "__main__":
    main()
