"""What the pages cost: the report of a training, the page of a sweep, and `analyze` of a long log, in CPU seconds.

    python -m benchmarks.pages [--run DIR] [--study NAME] [--log DIR] [--log-mb 100] [--turns 5] [--json FILE]

- `pictures_s`, `report_s`: best_lap.png and learning.png, and report.html, of a training of a million steps, in a
  process that has imported what a training has; what they import themselves is counted;
- `study_s`: `deepracer-exp sweep report NAME` in the working directory, with `--study` only;
- `analyze_s`: `deepracer-exp analyze` of a text log of so many megabytes, from the start of the process to its end. It
  repeats the longest log of `--log`, with increasing episodes and times.

Each is the best of `--turns` processes, because what others do on the machine only ever adds to it. CPU seconds, of all
threads, of user and system, do not depend on how many others wait for a core. Without `--run` a training of a million
steps is made first.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .analysis import CONSOLE_TRAINING, write_long_log
from .command import spent, train
from .report import benchmark_parser, number, table, with_exit_code, write_json

WANTED = {"report_s": 1.0, "study_s": 1.0, "analyze_s": 5.0}
STEPS = 1_000_000
_OF_RUN = """
import json, sys, time
from pathlib import Path

from deepracer_exp.config.parse import parse_experiment
from deepracer_exp.env.setup import build_setup, usual_cars
from deepracer_exp.reports.pages.run_page import write_pictures, write_run_page
from deepracer_exp.runs.run_files import read_config
from deepracer_exp.training import callbacks, run

folder = Path(sys.argv[1])
experiment = parse_experiment(read_config(folder))
setup = build_setup(experiment)
on_usual = usual_cars(setup.weights, experiment.randomization.car_share, experiment.collector.cars)
began = time.process_time()
write_pictures(folder, setup.courses, on_usual)
drawn = time.process_time()
note = write_run_page(folder, experiment.car)
print(json.dumps({"pictures_s": drawn - began, "report_s": time.process_time() - drawn, "note": note}))
"""


def of_run(run: Path) -> dict[str, float]:
    """Draw the pictures and write the page of a finished run again, in a process of its own; return CPU seconds.

    Raises:
        SystemExit: the page could not be written.
    """
    line = [sys.executable, "-c", _OF_RUN, str(run)]
    measured: dict[str, Any] = json.loads(subprocess.run(line, check=True, stdout=subprocess.PIPE).stdout)
    if (note := measured.pop("note")) is not None:
        raise SystemExit(note)
    return measured


def of_command(*arguments: str) -> float:
    """Return the CPU seconds of `deepracer-exp ARGUMENTS`.

    Raises:
        SystemExit: the command did not end with exit code 0.
    """
    _, usage = spent(*arguments)
    return usage.ru_utime + usage.ru_stime


def measure(
    folder: Path, run: Path | None, study: str | None, log: Path, log_mb: float, turns: int
) -> dict[str, float]:
    """Return the figures; what has to be made for them is made in a folder."""
    run = run or train([f"budget.env_steps={STEPS}", "stopping=none"], folder)
    source = max(log.rglob("*.log"), key=lambda file: file.stat().st_size)
    long_log = folder / source.name
    write_long_log(source, long_log, int(log_mb * 1e6))
    calls: list[Callable[[], dict[str, float]]] = [
        lambda: of_run(run),
        lambda: {"analyze_s": of_command("analyze", str(long_log), "--output", str(folder / "log.html"))},
    ]
    if study is not None:
        calls.append(lambda: {"study_s": of_command("sweep", "report", study)})
    best: dict[str, float] = {}
    for _ in range(turns):  # in turns, so that a busy minute does not meet one of them alone
        for call in calls:
            best |= {name: min(taken, best.get(name, taken)) for name, taken in call().items()}
    return {name: round(taken, 3) for name, taken in best.items()}


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("pages", __doc__, None)
    parser.add_argument(
        "--run", type=Path, help="folder of a finished run; its pictures and page are written again"
    )
    parser.add_argument("--study", metavar="NAME", help="a study of the working directory")
    parser.add_argument("--log", type=Path, default=CONSOLE_TRAINING, help="folder with a text log to repeat")
    parser.add_argument("--log-mb", type=float, default=100.0, help="size of the long log")
    parser.add_argument("--turns", type=int, default=5, help="processes of each, of which the best counts")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        figures = measure(
            Path(folder), options.run, options.study, options.log, options.log_mb, options.turns
        )
    names = {
        "pictures_s": "pictures of a training",
        "report_s": "report of a training",
        "study_s": "page of a sweep",
        "analyze_s": f"analyze of a log of {options.log_mb:g} MB",
    }
    rows = [
        (words, number(figures[name], 2), f"at most {WANTED[name]:.0f}" if name in WANTED else "")
        for name, words in names.items()
        if name in figures
    ]
    print(table(("CPU seconds", "measured", "wanted"), rows))
    write_json(options.json, {"log_mb": options.log_mb, **figures})


if __name__ == "__main__":
    sys.exit(main())
