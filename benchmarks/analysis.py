"""What a report of a training costs, and how fast logs are read.

    python -m benchmarks.analysis [--path DIR] [--turns 7] [--long-gb 2] [--json FILE]

- `report_s`, `peak_gb`: seconds and peak memory of `deepracer-exp analyze DIR`, from the start of the process to its
  end; the median and the largest of three runs;
- `read_ratio`: seconds that deepracer-utils takes to read the same folder, over ours; above 1 ours is faster. Both are
  loaded once before and read in turns within one process; the median of the turns' ratios.

Ours reads everything in the folder: training, evaluations and races from CSVs and text logs, policy updates, metrics
and settings. deepracer-utils reads the training with the one call that its documentation names for a folder,
`DeepRacerLog(...).load()`: of a console archive from the text log, of others from the CSVs. `read_ratio_csv` is the
harder comparison, with its quickest way to all drives: training and evaluations from the CSVs, races from the logs.

With `--long-gb` also a report of a text log of so many gigabytes, the longest log of the folder repeated: `long_s`,
`long_peak_gb`, and `long_steps` in the log, of which the last are held in memory (deepracer/sim_trace.py).

Wanted: at most 20 s and 1.5 GB on two cores for the 44,247 steps of the console training, `read_ratio` at least 1.
"""

import logging
import re
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from deepracer_exp.aws.logs.reader import read_recording

from .command import spent
from .report import benchmark_parser, number, table, with_exit_code, write_json

CONSOLE_TRAINING = Path(__file__).parents[2] / "shared/reference/console_training"
WANTED = {"report_s": 20.0, "peak_gb": 1.5, "read_ratio": 1.0}
"""At most, at most, at least."""
REPORTS = 3
_STEP = re.compile(rb"(.*?SIM_TRACE_LOG:)(\d+),(.*)", re.DOTALL)
_TIME = 13
"""Place of the time stamp among the values after the episode's number."""


def report(path: Path, page: Path) -> tuple[float, float]:
    """Return seconds and peak memory in GB of one report.

    Raises:
        SystemExit: the command did not end with exit code 0.
    """
    seconds, usage = spent("analyze", str(path), "--output", str(page))
    unit = 1 if sys.platform == "darwin" else 1024
    return seconds, usage.ru_maxrss * unit / 1e9


def peer(path: Path, all_drives: bool) -> None:
    """Read the folder with deepracer-utils."""
    from deepracer.logs import DeepRacerLog
    from deepracer.logs.misc import LogFolderType, LogType

    log = DeepRacerLog(model_folder=str(path))
    if not all_drives:
        log.load()
        return
    log.load_training_trace()
    log.load_evaluation_trace(force=True)
    if log.fh.type == LogFolderType.CONSOLE_MODEL_WITH_LOGS:
        log.load_robomaker_logs(LogType.LEADERBOARD, force=True)


def seconds(call: Callable[[], object]) -> float:
    """Return how long a call takes."""
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def measure_reading(path: Path, turns: int) -> dict[str, float]:
    """Read in turns."""
    calls: dict[str, Callable[[], object]] = {
        "read_s": lambda: read_recording(path),
        "peer_s": lambda: peer(path, all_drives=False),
        "peer_csv_s": lambda: peer(path, all_drives=True),
    }
    logging.getLogger("deepracer").setLevel(logging.ERROR)
    for call in calls.values():
        call()
    taken = [{name: seconds(call) for name, call in calls.items()} for _ in range(turns)]

    def ratio(name: str) -> float:
        return statistics.median(turn[name] / turn["read_s"] for turn in taken)

    figures = {name: statistics.median(turn[name] for turn in taken) for name in calls}
    return {**figures, "read_ratio": ratio("peer_s"), "read_ratio_csv": ratio("peer_csv_s")}


def measure_long(path: Path, gigabytes: float) -> dict[str, float]:
    """Report a long log."""
    source = max(path.rglob("*.log"), key=lambda file: file.stat().st_size)
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / source.name
        steps = write_long_log(source, log, int(gigabytes * 1e9))
        taken, peak = report(log, Path(folder) / "report.html")
    return {"long_gb": gigabytes, "long_steps": steps, "long_s": taken, "long_peak_gb": peak}


def write_long_log(source: Path, target: Path, size_bytes: int) -> int:
    """Write the whole log repeatedly until the target has the size; return the number of trace lines.

    Lines that number episodes themselves are left out: their numbers would differ from those of the steps.

    Raises:
        SystemExit: there is no trace line.
    """
    lines = [_taken_apart(line) for line in source.read_bytes().splitlines(keepends=True)]
    if not any(isinstance(line, tuple) for line in lines):
        raise SystemExit(f"{source}: no control step to be repeated")
    episodes = 1 + max(line[1] for line in lines if isinstance(line, tuple))
    times = [float(line[2][_TIME]) for line in lines if isinstance(line, tuple)]
    lasting_s = max(times) - min(times) + 1.0
    written = steps = 0
    with target.open("wb") as file:
        turn = 0
        while written < size_bytes:
            for line in lines:
                if isinstance(line, bytes):
                    written += file.write(line)
                    continue
                prefix, episode, values = line
                time = values[_TIME]
                later = b"%.3f%b" % (float(time) + turn * lasting_s, time[len(time.rstrip()) :])
                fields = [*values[:_TIME], later, *values[_TIME + 1 :]]
                written += file.write(b"%b%d,%b" % (prefix, episode + turn * episodes, b",".join(fields)))
                steps += 1
            turn += 1
    return steps


def _taken_apart(line: bytes) -> bytes | tuple[bytes, int, list[bytes]]:
    step = _STEP.fullmatch(line)
    if step is not None and step[3].count(b",") >= _TIME:
        return step[1], int(step[2]), step[3].split(b",")
    return b"" if b"Training> Name" in line else line


def measure(path: Path, turns: int, long_gb: float) -> dict[str, Any]:
    """Return all figures."""
    reading = measure_reading(path, turns)
    steps = len(read_recording(path).steps)
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "report.html"
        reports = [report(path, page) for _ in range(REPORTS)]
        size_mb = page.stat().st_size / 1e6
    figures = {
        "report_s": statistics.median(taken for taken, _ in reports),
        "peak_gb": max(peak for _, peak in reports),
        "page_mb": size_mb,
        **reading,
        **(measure_long(path, long_gb) if long_gb else {}),
    }
    return {"steps": steps, **{name: round(value, 3) for name, value in figures.items()}}


def show(figures: dict[str, Any]) -> str:
    """Return the figures as a table."""
    rows = [
        ("report, s", number(figures["report_s"], 1), f"at most {WANTED['report_s']:.0f}"),
        ("peak memory, GB", number(figures["peak_gb"], 2), f"at most {WANTED['peak_gb']}"),
        ("page, MB", number(figures["page_mb"], 1), "under 5"),
        ("reading, s", number(figures["read_s"], 3), ""),
        ("deepracer-utils, load(), s", number(figures["peer_s"], 3), ""),
        ("deepracer-utils, all drives, s", number(figures["peer_csv_s"], 3), ""),
        (
            "how much faster than load()",
            number(figures["read_ratio"], 2),
            f"at least {WANTED['read_ratio']:.0f}",
        ),
        ("how much faster than all drives", number(figures["read_ratio_csv"], 2), ""),
    ]
    if "long_gb" in figures:
        what = f"log of {figures['long_gb']:g} GB, {figures['long_steps']:,.0f} steps"
        rows.append((f"{what}: report, s", number(figures["long_s"], 0), ""))
        rows.append((f"{what}: peak memory, GB", number(figures["long_peak_gb"], 2), "bounded"))
    return table((f"{figures['steps']:,} steps", "measured", "wanted"), rows)


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("analysis", __doc__, None)
    parser.add_argument("--path", type=Path, default=CONSOLE_TRAINING, help="logs in a layout that both know")
    parser.add_argument("--turns", type=int, default=7, help="readings of each")
    parser.add_argument("--long-gb", type=float, default=0.0, help="size of a long log, none without")
    options = parser.parse_args(arguments)
    figures = measure(options.path, options.turns, options.long_gb)
    print(show(figures))
    write_json(options.json, figures)


if __name__ == "__main__":
    sys.exit(main())
