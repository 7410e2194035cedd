"""Recorded drives of every generation read as the same table."""

from pathlib import Path

import numpy as np
import pytest

from deepracer_exp.errors import BadInput
from deepracer_exp.formats.recorded import RECORDED_COLUMNS, read_recorded

REFERENCE = Path(__file__).parents[3] / "shared" / "reference" / "console_training"
recordings = pytest.mark.skipif(not REFERENCE.is_dir(), reason=f"no recordings at {REFERENCE}")

FIRST_15 = "3,2,1.5,-2.5,{yaw},{steer},2.00,{action},1.0000,False,True,12.5,7,17.71,20.5"
GENERATIONS = {
    15: "",
    16: ",in_progress",
    17: ",in_progress,0.00",
    18: ",in_progress,0.00,1655000000.5",
    19: ",in_progress,0.00,0,1655000000.5",
}


def log_line(fields: int, action: str = "4", yaw: str = "90.0", steer: str = "-30.0") -> str:
    return "SIM_TRACE_LOG:" + FIRST_15.format(yaw=yaw, steer=steer, action=action) + GENERATIONS[fields]


@pytest.mark.parametrize("fields", GENERATIONS)
def test_every_generation_of_log_lines_has_the_same_columns(tmp_path: Path, fields: int) -> None:
    (tmp_path / "a-robomaker.log").write_text(f"[agent-9] noise\n[agent-9] {log_line(fields)}\nmore noise\n")
    table = read_recorded(tmp_path)
    assert tuple(table.columns) == RECORDED_COLUMNS
    row = table.iloc[0]
    assert (row.episode, row.steps, row.X, row.progress, row.closest_waypoint) == (3, 2, 1.5, 12.5, 7)
    assert row.episode_status == ("" if fields == 15 else "in_progress")
    assert bool(row.all_wheels_on_track)
    assert not bool(row.done)


def test_the_radians_of_2019_become_degrees(tmp_path: Path) -> None:
    log = tmp_path / "old.log"
    log.write_text(log_line(15, yaw="1.5708", steer="-0.5236") + "\n")
    row = read_recorded(log).iloc[0]
    assert row.yaw == pytest.approx(90, abs=0.01)
    assert row.steer == pytest.approx(-30, abs=0.01)


def test_a_continuous_action_is_no_number(tmp_path: Path) -> None:
    log = tmp_path / "new.log"
    log.write_text(log_line(19, action="[-6.65667057  0.65535903]") + "\n")
    assert np.isnan(read_recorded(log)["action"].iloc[0])


def test_a_last_line_cut_off_while_written_is_left_out(tmp_path: Path) -> None:
    log = tmp_path / "running.log"
    log.write_text(log_line(17) + "\n" + log_line(17)[:40])
    assert len(read_recorded(log)) == 1


def test_a_torn_line_inside_a_log_is_named(tmp_path: Path) -> None:
    log = tmp_path / "torn.log"
    log.write_text(log_line(17) + "\n" + log_line(17)[:40] + "\n" + log_line(17) + "\n")
    with pytest.raises(BadInput, match=r"torn\.log:2: a trace line of"):
        read_recorded(log)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "empty"),
        ("episode,steps\n1,2\n", "no column X"),
        (",".join(RECORDED_COLUMNS[:15]) + "\n1,2,3\n", "3 values under 15"),
        (",".join(RECORDED_COLUMNS[:15]) + "\n" + ",".join(["x"] * 15) + "\n", "episode is 'x'"),
        (",".join(RECORDED_COLUMNS[:15]) + "\n" + ",".join(["nan"] * 15) + "\n", "accepted: a whole number"),
    ],
)
def test_a_malformed_trace_is_refused_in_one_line(tmp_path: Path, content: str, said: str) -> None:
    path = tmp_path / "0-iteration.csv"
    path.write_text(content)
    with pytest.raises(BadInput, match=said) as refused:
        read_recorded(tmp_path)
    assert "\n" not in str(refused.value)
    assert "0-iteration.csv" in str(refused.value)


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no recorded drive"):
        read_recorded(tmp_path)
    with pytest.raises(BadInput, match="no such file"):
        read_recorded(tmp_path / "absent")


@recordings
def test_the_log_and_the_csv_of_one_training_tell_the_same_drives() -> None:
    csv = read_recorded(REFERENCE / "sim-trace" / "training")
    log = read_recorded(REFERENCE / "logs" / "training")
    assert len(csv) == 44_247
    assert csv["iteration"].is_monotonic_increasing
    # The log has the evaluation episodes in between as well.
    both = csv.merge(log, on=["tstamp", "steps"], suffixes=("", "_log"))
    assert len(both) >= 44_000
    for name in ("X", "Y", "yaw", "progress"):
        assert np.abs(both[name] - both[f"{name}_log"]).max() <= 6e-5
    assert (both["episode_status"] == both["episode_status_log"]).all()
