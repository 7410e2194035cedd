from pathlib import Path

from deepracer_exp.rewards.prints import RewardPrints


def test_each_line_carries_the_number_of_its_car(tmp_path: Path) -> None:
    prints = RewardPrints(tmp_path / "log")
    prints.printer(3)("a", 1, sep="-", end="", flush=True)
    prints.printer(None)("two\nlines", sep=None)
    prints.printer(0)("\ud800ü")
    prints.close()
    prints.close()
    assert prints.path.read_text() == "car 3: a-1\nall cars: two\nall cars: lines\ncar 0: \\ud800ü\n"
    assert (prints.written, prints.dropped) == (3, 0)


def test_a_million_lines_leave_a_small_log_that_says_how_many_are_missing(tmp_path: Path) -> None:
    prints = RewardPrints(tmp_path / "log", lines_per_s=10.0)
    reward_print = prints.printer(0)
    for i in range(1_000_000):
        reward_print(i)
    prints.close()
    assert prints.written + prints.dropped == 1_000_000
    lines = prints.path.read_text().splitlines()
    reported = sum(int(line[1:].split()[0]) for line in lines if line.startswith("["))
    assert reported == prints.dropped
    assert len(lines) - sum(line.startswith("[") for line in lines) == prints.written < 1000


def test_the_log_stays_below_its_size(tmp_path: Path) -> None:
    prints = RewardPrints(tmp_path / "log", lines_per_s=1e9, max_bytes=1000)
    for _ in range(500):
        prints.printer(0)("x" * 90)
    prints.printer(0)("x" * 10_000_000)
    prints.close()
    assert 900 < prints.path.stat().st_size < 1100
    assert prints.dropped > 480


def test_two_processes_worth_of_logs_share_a_file_line_by_line(tmp_path: Path) -> None:
    a, b = RewardPrints(tmp_path / "log"), RewardPrints(tmp_path / "log")
    for i in range(5):
        a.printer(0)(i)
        b.printer(1)(i)
    a.close()
    b.close()
    assert a.path.read_text() == "".join(f"car 0: {i}\ncar 1: {i}\n" for i in range(5))


def test_a_folder_that_is_missing_never_reaches_the_reward(tmp_path: Path) -> None:
    prints = RewardPrints(tmp_path / "missing" / "log")
    prints.printer(0)("a")
    prints.printer(0)("b")
    prints.close()
    assert isinstance(prints.error, FileNotFoundError)
    assert (prints.written, prints.dropped) == (0, 2)
