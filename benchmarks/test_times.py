"""Which tests take the time of `make test`: the slowest files, from the report that it writes.

    python -m benchmarks.test_times [REPORT] [--files 20]

REPORT is a JUnit file of pytest, by default that of the last `make test`. Seconds are those of two processes beside
each other, on the machine that made the report. `.ci/run` prints the table after its tests; docs/measured/tests.md has
it.
"""

import sys
import xml.etree.ElementTree as ElementTree
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path

from deepracer_exp.errors import BadInput

from .report import benchmark_parser, number, percent, table, with_exit_code

REPORT = Path("test_times.xml")


def slowest(report: Path, files: int) -> tuple[str, str]:
    """Return what a report counts in all, and the table of its slowest files.

    Raises:
        BadInput: there is no such report.
    """
    try:
        suite = ElementTree.parse(report).getroot()[0]
    except (OSError, ElementTree.ParseError, IndexError) as error:
        raise BadInput(report, f"no report of pytest ({error})", "a file of `pytest --junitxml`") from error
    seconds: dict[str, float] = defaultdict(float)
    tests: Counter[str] = Counter()
    for case in suite.iter("testcase"):
        module = f"{case.get('classname', '').replace('.', '/')}.py"
        seconds[module] += float(case.get("time", 0.0))
        tests[module] += 1
    tests_s = sum(seconds.values())
    files_of = sorted(seconds, key=lambda module: -seconds[module])[:files]
    rows = [
        (f"`{module}`", str(tests[module]), number(seconds[module], 1), percent(seconds[module] / tests_s, 1))
        for module in files_of
    ]
    took_s = float(suite.get("time", 0.0))
    total = (
        f"{tests.total()} tests in {len(tests)} files: {tests_s:.0f} s, by two processes in {took_s:.0f} s"
    )
    return total, table(("file", "tests", "seconds", "of all"), rows)


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Read and print."""
    parser = benchmark_parser("test_times", __doc__, json=False)
    parser.add_argument("report", nargs="?", type=Path, default=REPORT)
    parser.add_argument("--files", type=int, default=20, help="how many")
    options = parser.parse_args(arguments)
    total, rows = slowest(options.report, options.files)
    print(f"{total}\n\n{rows}")


if __name__ == "__main__":
    sys.exit(main())
