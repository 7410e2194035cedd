"""Laws of the simulation trace."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deepracer_exp.config.driving import QUANTITIES
from deepracer_exp.env.trace_columns import (
    EPISODE_STATUS,
    PACKED,
    PACKED_COLUMNS,
    SCHEMA,
    STATUS_CODE,
    TRACE_COLUMNS,
    to_table,
)
from deepracer_exp.env.trace_rows import row_dtype
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.runs.trace import DECIMALS, MOST_ROWS, TraceWriter, read_trace
from tests.conftest import REFERENCE, refused
from tests.examples import examples

CONSOLE = REFERENCE / "console_training/sim-trace/training/training-simtrace"
WHOLE = ("episode", "steps", "action", "closest_waypoint", "car")
YES_NO = ("done", "all_wheels_on_track")
TRACKS = ("Oval_track", "Bowtie_track", "2022_summit_speedway")


def packed_rows(count: int, seed: int = 0) -> np.ndarray:
    draw = np.random.default_rng(seed)
    rows = draw.normal(size=(count, len(PACKED_COLUMNS)))
    for name in WHOLE:
        rows[:, PACKED[name]] = draw.integers(0, 500, count)
    for name in YES_NO:
        rows[:, PACKED[name]] = draw.integers(0, 2, count)
    rows[:, PACKED["episode_status"]] = draw.integers(0, len(EPISODE_STATUS), count)
    rows[:, PACKED["track"]] = draw.integers(0, len(TRACKS), count)
    return rows


def table(count: int = 7, iteration: int = 3) -> pa.Table:
    return to_table(packed_rows(count, iteration), iteration, TRACKS)


@pytest.mark.skipif(not CONSOLE.is_dir(), reason="no recording of the console beside the project")
def test_a_recording_of_the_console_goes_through_packed_rows_unchanged() -> None:
    recorded = pd.read_csv(CONSOLE / "6-iteration.csv")
    assert TRACE_COLUMNS[: len(recorded.columns)] == tuple(recorded.columns)
    coded = recorded.assign(episode_status=recorded["episode_status"].map(STATUS_CODE))
    packed = coded.reindex(columns=PACKED_COLUMNS, fill_value=0).to_numpy(dtype=np.float64)
    trace = to_table(packed, 6, TRACKS).to_pandas()
    for name in recorded.columns:
        values = trace[name].astype(str) if name == "episode_status" else trace[name]
        np.testing.assert_array_equal(values, recorded[name], err_msg=name)


@given(rows=arrays(np.float64, (3, len(PACKED_COLUMNS)), elements=st.floats(-1e9, 1e9)))
def test_no_double_column_loses_a_bit(rows: np.ndarray) -> None:
    rows[:, [PACKED["episode_status"], PACKED["track"]]] = 1
    trace = to_table(rows, 0, TRACKS)
    for field in SCHEMA:
        if field.name in PACKED and field.type == pa.float64():
            np.testing.assert_array_equal(trace[field.name].to_numpy(), rows[:, PACKED[field.name]])


def test_every_column_has_its_type_and_says_its_unit() -> None:
    trace = table()
    assert trace.schema.equals(SCHEMA)
    assert trace.column_names == list(TRACE_COLUMNS)
    assert all(trace.schema.field(name).metadata[b"unit"] for name in TRACE_COLUMNS)


def test_every_code_becomes_its_word() -> None:
    rows = packed_rows(len(EPISODE_STATUS))
    rows[:, PACKED["episode_status"]] = np.arange(len(EPISODE_STATUS))
    rows[:3, PACKED["track"]] = [2, 0, 1]
    trace = to_table(rows, 0, TRACKS)
    assert trace["episode_status"].to_pylist() == list(EPISODE_STATUS)
    assert trace["track"].to_pylist()[:3] == [TRACKS[2], TRACKS[0], TRACKS[1]]
    with pytest.raises(ValueError, match="track code 2"):
        to_table(rows, 0, TRACKS[:2])


@pytest.mark.parametrize("code", [-1, len(EPISODE_STATUS), 256, 0.5, np.nan])
def test_an_unknown_status_code_is_refused(code: float) -> None:
    rows = packed_rows(3)
    rows[1, PACKED["episode_status"]] = code
    with pytest.raises(ValueError, match="status code"):
        to_table(rows, 0, TRACKS)


def test_a_continuous_action_has_no_number_but_its_steering_and_speed() -> None:
    rows = packed_rows(2)
    rows[:, PACKED["action"]] = np.nan
    rows[:, PACKED["steer"]] = [-12.5, 31.0]
    trace = to_table(rows, 0, TRACKS)
    assert trace["action"].to_pylist() == [None, None]
    assert trace["steer"].to_pylist() == [-12.5, 31.0]


def written(folder: Path, iteration: int, steps: pa.Table) -> None:
    """Write the file of one iteration."""
    writer = TraceWriter(folder)
    writer.add(iteration, steps)
    writer.flush()


def test_no_rows_are_a_table_too(tmp_path: Path) -> None:
    written(tmp_path, 0, table(0))
    assert list(read_trace(tmp_path).columns) == list(TRACE_COLUMNS)


def test_what_was_written_is_read_in_the_order_of_iterations(tmp_path: Path) -> None:
    folder = tmp_path / "trace mit Ümläuten"
    for iteration in (10, 9, 100_000):
        written(folder, iteration, table(iteration=iteration))
        assert (folder / f"{iteration:05d}-iteration.parquet").is_file()
    trace = read_trace(folder)
    assert trace["iteration"].tolist() == [9] * 7 + [10] * 7 + [100_000] * 7
    assert trace.index.tolist() == list(range(21))
    driven = table(iteration=9).to_pandas()
    for name in driven.columns:
        kept = {"atol": 0.51 * 10.0 ** -DECIMALS[name]} if name in DECIMALS else {"rtol": 1e-7}
        if driven[name].dtype.kind == "f":
            np.testing.assert_allclose(trace[name][:7], driven[name], **kept, err_msg=name)
        else:
            np.testing.assert_array_equal(trace[name][:7].astype(str), driven[name].astype(str), err_msg=name)


@given(reward=st.floats(-1e30, 1e30, allow_subnormal=False))
@examples(100)
def test_a_reward_of_any_size_keeps_seven_digits(
    reward: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("trace")
    rows = packed_rows(1)
    rows[:, PACKED["reward"]] = reward
    written(folder, 0, to_table(rows, 0, TRACKS))
    assert read_trace(folder)["reward"][0] == pytest.approx(reward, rel=1e-7, abs=1e-37)


def test_the_rows_of_all_iterations_since_the_last_file_are_in_the_next(tmp_path: Path) -> None:
    writer = TraceWriter(tmp_path)
    for iteration in (1, 2, 3):
        writer.add(iteration, table(iteration=iteration))
    assert list(tmp_path.iterdir()) == []
    for _ in range(2):  # there is nothing more to write
        writer.flush()
        assert [path.name for path in tmp_path.iterdir()] == ["00003-iteration.parquet"]
    written(tmp_path, 4, table(iteration=4))
    assert read_trace(tmp_path)["iteration"].tolist() == [1] * 7 + [2] * 7 + [3] * 7 + [4] * 7


def test_a_file_is_written_before_its_rows_fill_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert MOST_ROWS <= 200_000
    monkeypatch.setattr("deepracer_exp.runs.trace.MOST_ROWS", 1000)
    TraceWriter(tmp_path).add(5, table(1000))
    assert [path.name for path in tmp_path.iterdir()] == ["00005-iteration.parquet"]


def test_a_rounded_row_takes_less_than_sixteen_bytes_on_a_driven_lap(tmp_path: Path) -> None:
    rows = np.concatenate([packed_rows(1)] * 60_000)
    random = np.random.default_rng(0)
    turn = np.cumsum(random.normal(0.0, 0.02, len(rows)))
    noise = {
        **{"X": np.cumsum(0.2 * np.cos(turn)) % 10, "Y": np.cumsum(0.2 * np.sin(turn)) % 5},
        **{"yaw": np.degrees(turn) % 360 - 180, "steer": random.normal(0.0, 10.0, len(rows))},
        **{"progress": np.arange(len(rows)) * 1.4 % 100, "reward": random.normal(0.2, 0.1, len(rows))},
        "speed_mps": random.normal(3.0, 0.3, len(rows)),
    }
    for name, values in noise.items():
        rows[:, PACKED[name]] = values
    written(tmp_path, 1, to_table(rows, 1, TRACKS))
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 16 * len(rows)


def test_traces_written_before_columns_were_rounded_are_read(tmp_path: Path) -> None:
    pq.write_table(table(), tmp_path / "00003-iteration.parquet")
    pd.testing.assert_frame_equal(read_trace(tmp_path), table().to_pandas(), check_categorical=False)


def test_a_write_that_fails_leaves_no_part_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def disk_full(table: pa.Table, where: Path, **options: object) -> None:
        where.write_bytes(b"PAR1 half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", disk_full)
    with pytest.raises(RunFailed, match=r"00003-iteration\.parquet.*No space left on device"):
        written(tmp_path, 3, table())
    assert list(tmp_path.iterdir()) == []


def test_the_wanted_columns_of_finished_files_are_read(tmp_path: Path) -> None:
    written(tmp_path, 0, table(2))
    written(tmp_path, 0, table(7))  # again: replaces the first
    (tmp_path / ".00001-iteration.parquet").write_bytes(b"PAR1 half")
    trace = read_trace(tmp_path, ("X", "episode_status"))
    assert (list(trace.columns), len(trace)) == (["X", "episode_status"], 7)


@pytest.mark.parametrize("content", [b"", b"PAR1 half", b"episode,steps\n1,2\n" * 10, None])
def test_a_corrupt_file_is_named(tmp_path: Path, content: bytes | None) -> None:
    written(tmp_path, 0, table())
    file = tmp_path / "00001-iteration.parquet"
    if content is None:
        pq.write_table(pa.table({"episode": [1]}), file)
    else:
        file.write_bytes(content)
    assert "00001-iteration.parquet" in refused(read_trace, tmp_path)


def test_a_folder_without_a_trace_is_named(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(BadInput, match=r"accepted: the folder of a run with its trace"):
            read_trace(folder)


def test_the_records_that_a_race_writes_are_the_packed_columns_in_their_order():
    extra = ("own_episode", "bots_stopped")
    records = row_dtype(extra)
    assert records.itemsize == 8 * (len(PACKED) + len(extra))
    places = {name: kind[1] // 8 for name, kind in records.fields.items()}
    randomized = places.pop("randomized")
    expected = {**PACKED, **{name: len(PACKED) + number for number, name in enumerate(extra)}}
    assert [expected.pop(name) for name in QUANTITIES] == list(
        range(randomized, randomized + len(QUANTITIES))
    )
    assert places == expected
