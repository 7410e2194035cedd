"""Run the tests that start processes, wait or read a clock again and again beside twelve busy processes.

    python -m tests.busy_machine [--times 20] [--busy 12] [PYTEST_ARGUMENT...]

Each time in another order of the modules. The exit code is that of the first run that failed; none is repeated.
"""

import argparse
import subprocess
import sys


def main() -> int:
    """Run them; print a line a run."""
    parser = argparse.ArgumentParser(prog="python -m tests.busy_machine", description=__doc__)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument(
        "--busy", type=int, default=12, help="processes beside them that compute all the time"
    )
    options, arguments = parser.parse_known_args()
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(options.busy)]
    try:
        for turn in range(1, options.times + 1):
            order = f"--random-order-seed={turn}"
            tests = [
                "-q",
                "-m",
                "processes and not slow and not faults",
                "-n",
                "2",
                "--dist",
                "worksteal",
                order,
                *arguments,
            ]
            done = subprocess.run([sys.executable, "-m", "pytest", *tests], check=False)
            print(f"{turn} of {options.times}: exit code {done.returncode}", flush=True)
            if done.returncode:
                return done.returncode
    finally:
        for process in busy:
            process.kill()
    return 0


if __name__ == "__main__":
    sys.exit(main())
