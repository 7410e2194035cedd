import time
from pathlib import Path

import psutil

from deepracer_exp.rewards.prints import RewardPrints


def test_each_line_carries_the_number_of_its_car(tmp_path: Path) -> None:
    prints = RewardPrints(tmp_path / "log")
    prints.printer(3)("a", 1, sep="-", end="", flush=True)
    prints.printer(None)("two\nlines", sep=None)
    prints.printer(0)("\ud800ü")
    assert (
        prints.path.read_text(encoding="utf-8")
        == "car 3: a-1\nall cars: two\nall cars: lines\ncar 0: \\ud800ü\n"
    )
    assert prints.dropped == 0


def test_a_million_lines_leave_a_small_log_that_says_how_many_are_missing(tmp_path: Path) -> None:
    prints = RewardPrints(tmp_path / "log", lines_per_s=10.0)
    reward_print = prints.printer(0)
    for i in range(1_000_000):
        reward_print(i)
    time.sleep(0.2)
    reward_print("the last")
    lines = prints.path.read_text().splitlines()
    reported = sum(int(line[1:].split()[0]) for line in lines if line.startswith("["))
    assert reported == prints.dropped
    written = len(lines) - sum(line.startswith("[") for line in lines)
    assert written + prints.dropped == 1_000_001
    assert written < 1000


def test_the_log_stays_below_its_size(tmp_path: Path) -> None:
    prints = RewardPrints(tmp_path / "log", lines_per_s=1e9, max_bytes=1000)
    for _ in range(500):
        prints.printer(0)("x" * 90)
    prints.printer(0)("x" * 10_000_000)
    assert 900 < prints.path.stat().st_size < 1100
    assert prints.dropped > 480


def test_two_processes_worth_of_logs_share_a_file_line_by_line(tmp_path: Path) -> None:
    a, b = RewardPrints(tmp_path / "log"), RewardPrints(tmp_path / "log")
    for i in range(5):
        a.printer(0)(i)
        b.printer(1)(i)
    assert a.path.read_text() == "".join(f"car 0: {i}\ncar 1: {i}\n" for i in range(5))


def test_a_folder_that_is_missing_never_reaches_the_reward(tmp_path: Path) -> None:
    prints = RewardPrints(tmp_path / "missing" / "log")
    prints.printer(0)("a")
    prints.printer(0)("b")
    assert isinstance(prints.error, FileNotFoundError)
    assert prints.dropped == 2


def test_the_log_of_a_run_that_is_over_is_closed(tmp_path: Path) -> None:
    before = psutil.Process().num_fds()
    for run in range(50):
        RewardPrints(tmp_path / f"{run}.log").printer(0)("a")
    assert psutil.Process().num_fds() < before + 10
