"""A long log made of a short one is read as one long training."""

import pytest

from benchmarks.analysis import write_long_log
from deepracer_exp.aws.logs.reader import read_recording
from tests.aws import made_up_logs as made


# Lines that are left out make a turn shorter than the file, the more the shorter the others are.
@pytest.mark.parametrize(("fields", "size"), [(15, 2.8), (17, 3.5)])
def test_every_turn_is_driven_later_and_in_episodes_of_its_own(tmp_path, fields, size):
    short, long = tmp_path / "short.log", tmp_path / "long.log"
    rows = made.drives([0, 1, 2])
    short.write_text(made.log_text(rows, fields) + made.trainer_text(2))
    steps = write_long_log(short, long, int(size * short.stat().st_size))
    assert steps == 4 * len(rows)
    recording = read_recording(long)
    assert not recording.problems
    assert recording.steps["episode"].tolist() == sorted(list(range(12)) * 6)
    assert recording.steps["tstamp"].is_monotonic_increasing
    for name in ("X", "Y", "reward", "progress"):
        assert recording.steps[name].tolist() == 4 * read_recording(short).steps[name].tolist()
