"""Lines of every generation, and what of a damaged file can still be read."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.aws.logs import blocks, sim_trace, text_log
from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.aws.logs.recorded import Recording
from deepracer_exp.errors import BadInput
from tests.conftest import refused
from tests.examples import examples
from tests.memory import traced

from . import made_up_logs as made

ROWS = made.drives([0, 1, 2], seed=3)
GENERATIONS = sorted(made.FIELDS)
PREFIXES = (
    "",
    "[download_node-1] [agent-9] ",
    "1654981129000,",
    "deepracer-0_robomaker.1.abc@host    | \x1b[33m[ WARN]\x1b[0m ",
    '{"log":"',
)


def read_or_refused(path: Path) -> Recording | None:
    """Return the recording, None if it was refused as it should be."""
    try:
        return read_recording(path)
    except BadInput as error:
        complaint = str(error)
    assert "\n" not in complaint
    assert len(complaint) < 1000
    return None


@pytest.mark.parametrize(
    ("fields", "prefix"), [*zip(GENERATIONS, PREFIXES, strict=True), (19, ""), (15, PREFIXES[-1])]
)
def test_every_generation_of_lines_with_any_prefix_has_the_same_columns(tmp_path, fields, prefix):
    suffix = '\\n","stream":"stdout"}' if prefix.startswith("{") else "\r" if prefix else "\tmore"
    log = tmp_path / "a-robomaker.log"
    log.write_text(
        "".join(f"{made.line(row, fields, prefix)}{suffix}\n" for row in ROWS.itertuples()), newline=""
    )
    recording = read_recording(log)
    assert not recording.problems
    steps = recording.steps
    for name in ("X", "Y", "yaw", "progress"):
        np.testing.assert_allclose(steps[name], ROWS[name], rtol=0, atol=6e-5)
    for name in ("episode", "steps", "done", "all_wheels_on_track", "tstamp", "action"):
        np.testing.assert_array_equal(steps[name], ROWS[name])
    status = [""] * len(ROWS) if fields == 15 else ROWS["episode_status"].tolist()
    assert steps["episode_status"].astype(str).tolist() == status
    assert steps["pause_duration"].eq(0).all()
    assert steps["obstacle_crash_counter"].notna().all() == (fields == 19)
    assert steps["wall_clock"].notna().all() == (fields >= 18)
    assert steps["speed_mps"].isna().all()


@pytest.mark.parametrize("fields", GENERATIONS)
def test_every_generation_of_csv_goes_by_its_names(tmp_path, fields):
    file = tmp_path / "0-iteration.csv"
    file.write_text(made.csv_text(ROWS, fields))
    steps = read_recording(file).steps
    np.testing.assert_array_equal(steps["X"], ROWS["X"])
    assert steps["obstacle_crash_counter"].notna().all() == (fields >= 18)
    assert steps["wall_clock"].notna().all() == (fields == 19)


def test_the_eighteenth_value_is_a_counter_or_a_clock_by_its_size(tmp_path):
    rows = ROWS.assign(wall_clock=[2] * 9 + [1.7e9] * 9)
    (tmp_path / "a.log").write_text(made.log_text(rows, 18))
    steps = read_recording(tmp_path).steps
    assert steps["obstacle_crash_counter"].tolist()[:9] == [2] * 9
    assert steps["wall_clock"].isna().tolist() == [True] * 9 + [False] * 9


def test_the_radians_of_2019_become_degrees_and_later_degrees_stay(tmp_path):
    radians = ROWS.assign(yaw=np.radians(ROWS["yaw"]), steer=np.radians(ROWS["steer"]))
    (tmp_path / "old.log").write_text(made.log_text(radians, 15))
    (tmp_path / "later.log").write_text(made.log_text(ROWS, 15))
    for name in ("old", "later"):
        steps = read_recording(tmp_path / f"{name}.log").steps
        np.testing.assert_allclose(steps["yaw"], ROWS["yaw"], rtol=0, atol=0.004)
        np.testing.assert_allclose(steps["steer"], ROWS["steer"], rtol=0, atol=0.4)


@pytest.mark.parametrize(
    "action",
    ["[-6.65667057  0.65535903]", "[ 5.  1.]", "[-30.0, 1.21]"],
)
def test_a_continuous_action_is_no_number(tmp_path, action):
    rows = ROWS.assign(action=action)
    # The service puts no value in quotes.
    files = {
        "a-robomaker.txt": made.log_text(rows),
        "b/0-iteration.csv": made.csv_text(rows).replace('"', ""),
    }
    made.write_folder(files | {"quoted/0-iteration.csv": made.csv_text(rows, 19)}, tmp_path)
    for path in (tmp_path / "a-robomaker.txt", tmp_path / "b", tmp_path / "quoted"):
        recording = read_recording(path)
        assert not recording.problems
        assert recording.steps["action"].isna().all()
        assert recording.steps["episode_status"].astype(str).tolist() == ROWS["episode_status"].tolist()
        np.testing.assert_allclose(recording.steps["reward"], ROWS["reward"], rtol=0, atol=6e-5)


def test_a_continuous_action_cut_off_by_the_end_of_a_log_is_listed(tmp_path):
    lines = made.log_text(ROWS.assign(action="[-30.0, 1.21]")).splitlines()[:-1]
    for end in range(lines[-1].index("["), lines[-1].index("]")):
        (tmp_path / "robomaker.log").write_text("\n".join([*lines[:-1], lines[-1][:end]]))
        recording = read_recording(tmp_path)
        assert len(recording.steps) == len(ROWS) - 1
        assert [problem.line for problem in recording.problems] == [len(lines)]


@pytest.mark.parametrize("name", ["0-iteration.csv", "a-robomaker.log"])
def test_a_file_whose_first_rows_cannot_be_read_is_given_up_early_and_the_first_one_is_named(
    tmp_path, name, monkeypatch
):
    read: list[int] = []

    def counted(data, *args, **options):
        read.append(data.count(b"\n"))
        return read_rows(data, *args, **options)

    read_rows = sim_trace.read_rows
    monkeypatch.setattr(blocks, "SIZE", 2**16)
    for module in (sim_trace, text_log):
        monkeypatch.setattr(module, "read_rows", counted)
    header, row = made.csv_text(ROWS).splitlines()[:2]
    bad = f"{row},more,evenmore,most"
    lines = [header, *[bad] * 20_000] if name.endswith(".csv") else [f"SIM_TRACE_LOG:{bad}"] * 20_000
    (tmp_path / name).write_text("\n".join(lines))
    first = 2 if name.endswith(".csv") else 1
    assert f"{name}:{first}: 20 values; accepted: " in refused(read_recording, tmp_path / name)
    assert sum(read) < 2 * sim_trace.MOST_REFUSED
    # Beside a file that can be read the rest is counted as one problem.
    (tmp_path / "1-iteration.csv").write_text(made.csv_text(ROWS))
    recording = read_recording(tmp_path)
    assert len(recording.steps) == len(ROWS)
    assert any("more that cannot be read" in problem.reason for problem in recording.problems)


def test_a_file_that_begins_badly_is_read_from_where_it_can_be(tmp_path):
    header, *rows = made.csv_text(ROWS).splitlines()
    bad = [f"{rows[0]},more"] * (sim_trace.MOST_REFUSED - 1)
    (tmp_path / "0-iteration.csv").write_text("\n".join([header, *bad, *rows]))
    assert len(read_recording(tmp_path).steps) == len(ROWS)


def test_generations_one_after_the_other_in_one_file_are_all_read(tmp_path):
    rows = [ROWS.assign(episode=ROWS["episode"] + 3 * at) for at in range(len(GENERATIONS))]
    (tmp_path / "a.log").write_text("".join(map(made.log_text, rows, GENERATIONS)))
    recording = read_recording(tmp_path)
    assert not recording.problems
    assert len(recording.steps) == len(ROWS) * len(GENERATIONS)
    (tmp_path / "all.csv").write_text("\n".join(map(made.csv_text, rows, GENERATIONS)))
    assert len(read_recording(tmp_path / "all.csv").steps) == len(ROWS) * len(GENERATIONS)


def test_incomplete_lines_are_listed_with_their_numbers_and_the_others_are_read(tmp_path):
    lines = [made.line(row) for row in ROWS.itertuples()]
    lines[2] = lines[2].rsplit(",", 2)[0]  # as many values as a line of 2019
    lines[7] = lines[7].replace("False", "Fal", 1)
    lines[9] = lines[9][:40]
    lines[-1] = lines[-1].rsplit(",", 1)[0]
    log = tmp_path / "incomplete.log"
    log.write_text("some noise\n" + "\n".join(lines))
    recording = read_recording(log)
    assert len(recording.steps) == len(ROWS) - 4
    assert [problem.line for problem in recording.problems] == [4, 9, 11, 19]
    reasons = [problem.reason for problem in recording.problems]
    assert "incomplete" in reasons[0]
    assert reasons[1] == "done is 'Fal'; accepted: True or False"
    assert all(str(problem).startswith(f"{log}:") for problem in recording.problems)


def test_bad_rows_of_a_csv_are_listed_with_their_numbers(tmp_path):
    lines = made.csv_text(ROWS).splitlines()
    lines[3] = lines[3].replace(",", ";")
    lines[5] = ",".join(["x", *lines[5].split(",")[1:]])
    lines[8] = ",".join(["0", "2", "inf", *lines[8].split(",")[3:]])
    lines.insert(10, "")
    lines.append(lines[-1][:30])
    file = tmp_path / "0-iteration.csv"
    file.write_text("\n".join(lines))
    recording = read_recording(file)
    assert len(recording.steps) == len(ROWS) - 3
    assert [problem.line for problem in recording.problems] == [4, 6, 9, 21]
    assert recording.problems[1].reason == "episode is 'x'; accepted: a number"


@pytest.mark.parametrize(
    ("column", "value", "accepted"),
    [
        ("closest_waypoint", "2000000000", "a whole number from 0 to 99999"),
        ("action", "2000000000", "an action up to 9999"),
        ("track_len", "0.0", "a length above 0"),
        ("X", "1e308", "a number from -1e+09 to 1e+09"),
        ("Y", "-inf", "a number from -1e+09 to 1e+09"),
        ("progress", "nan", "a number from -1e+09 to 1e+09"),
        ("reward", "-1e308", "a number from -1e+100 to 1e+100"),
        ("tstamp", "1e300", "a number from -1e+12 to 1e+12"),
        ("pause_duration", "inf", "a number from -1e+09 to 1e+09"),
    ],
)
def test_values_that_no_track_and_no_policy_has_are_listed(tmp_path, column, value, accepted):
    lines = made.csv_text(ROWS).splitlines()
    values = lines[4].split(",")
    values[lines[0].split(",").index(column)] = value
    (tmp_path / "0-iteration.csv").write_text("\n".join([*lines[:4], ",".join(values), *lines[5:]]))
    recording = read_recording(tmp_path)
    assert len(recording.steps) == len(ROWS) - 1
    assert [problem.reason for problem in recording.problems] == [
        f"{column} is '{value}'; accepted: {accepted}"
    ]


def test_a_date_in_the_name_of_a_trace_is_not_its_iteration(tmp_path):
    (tmp_path / "20220611230353-iteration.csv").write_text(made.csv_text(ROWS))
    assert read_recording(tmp_path).steps["iteration"].max() < len(ROWS)


def test_many_bad_lines_are_counted(tmp_path):
    (tmp_path / "a.log").write_text(made.log_text(ROWS) + "SIM_TRACE_LOG:rubbish\n" * 500)
    recording = read_recording(tmp_path)
    assert len(recording.problems) == 21
    assert sum(problem.lines for problem in recording.problems if problem.line is not None) == 500
    assert recording.problems[-1].reason.endswith("the last one in line 521")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "latin-1"])
def test_other_encodings_are_read(tmp_path, encoding):
    text = "gemütlich\n" * 3 + made.log_text(ROWS, prefix="müde: ")
    (tmp_path / "a.log").write_bytes(text.encode(encoding))
    (tmp_path / "b").mkdir()
    (tmp_path / "b/0-iteration.csv").write_bytes(made.csv_text(ROWS).encode(encoding))
    for path in (tmp_path / "a.log", tmp_path / "b"):
        recording = read_recording(path)
        assert (len(recording.steps), recording.problems) == (len(ROWS), ())


def test_policy_updates_that_diverged_are_read_and_incomplete_ones_listed(tmp_path):
    good = made.trainer_text(2).replace("1.900", "nan")
    (tmp_path / "sagemaker.log").write_text(good + "Policy training> Surrogate loss=0.1, KL diver\n")
    recording = read_recording(tmp_path)
    assert recording.updates["entropy"].isna().tolist() == [False, False, True, True]
    (problem,) = recording.problems
    assert problem.reason == "a policy update that cannot be read"
    assert problem.line == len(good.splitlines()) + 1


def test_a_truncated_archive_gives_what_can_be_read(tmp_path):
    rng = np.random.default_rng(0)
    files = made.console() | {"z.log": rng.bytes(200_000).hex()}
    path = made.write_archive(files, tmp_path / "model.tar.gz")
    raw = path.read_bytes()
    whole = len(read_recording(path).steps)
    seen = set()
    for share in (0.02, 0.3, 0.9):
        path.write_bytes(raw[: int(share * len(raw))])
        recording = read_or_refused(path)
        if recording is None:
            continue
        seen.add(len(recording.steps))
        assert any("cannot be read to its end" in problem.reason for problem in recording.problems)
    assert seen
    assert max(seen) <= whole


@pytest.mark.processes
def test_a_large_log_with_few_trace_lines_takes_little_memory(tmp_path):
    log = tmp_path / "large.log"
    noise = (
        b"[ WARN] [1654981129.973417277]: [ClientConfiguration] Retry Strategy will use the default.\n"
        * 11_000
    )
    with log.open("wb") as file:
        for number in range(90):  # 90 MB
            file.write(noise)
            if number % 30 == 0:
                file.write(made.log_text(ROWS.assign(episode=ROWS["episode"] + number)).encode())
    with traced() as peak:
        recording = read_recording(log)
        assert peak() < 60e6
    assert len(recording.steps) == 3 * len(ROWS)


def test_a_line_without_end_is_skipped_and_reported(tmp_path):
    log = tmp_path / "a.log"
    with log.open("wb") as file:
        file.write(made.log_text(ROWS).encode())
        for _ in range(40):
            file.write(b"\0" * 2**20)
        file.write(
            b"\n" + made.log_text(ROWS.assign(episode=ROWS["episode"] + 9)).encode() + b"SIM_TRACE_LOG:1\n"
        )
    recording = read_recording(log)
    assert len(recording.steps) == 2 * len(ROWS)
    first = len(ROWS) + 4
    assert [problem.line for problem in recording.problems] == [2 * first, first]
    assert "a line of more than 16 MiB" in recording.problems[1].reason


FILES = ("a.log", "0-iteration.csv", "a.tar.gz", "TrainingMetrics.json")
characters = st.sampled_from(list("0123456789.,-[]\"'\\\r\t :TFaex_\0é\x1b"))
edits = st.lists(
    st.tuples(st.floats(0, 1, exclude_max=True), st.sampled_from(["put", "cut", "over"]), characters),
    max_size=12,
)


def damaged(text: str, changes: list[tuple[float, str, str]]) -> str:
    for share, kind, character in changes:
        at = int(share * len(text))
        new = "" if kind == "cut" else character
        text = text[:at] + new + text[at if kind == "put" else at + 1 :]
    return text


@given(is_csv=st.booleans(), fields=st.sampled_from(GENERATIONS), changes=edits, cut=st.floats(0.1, 1))
@examples(150)
def test_every_line_of_a_trace_is_read_or_listed(tmp_path_factory, is_csv, fields, changes, cut):
    head, _, body = made.csv_text(ROWS, fields).partition("\n")
    body = damaged(body if is_csv else made.log_text(ROWS, fields), changes)
    body = body[: int(cut * len(body))]
    file = tmp_path_factory.mktemp("fuzz") / ("0-iteration.csv" if is_csv else "a.log")
    file.write_text(f"{head}\n{body}" if is_csv else body, newline="")
    present = sum(bool(line.strip()) if is_csv else "SIM_TRACE_LOG:" in line for line in body.split("\n"))
    recording = read_or_refused(file)
    if recording is not None:
        assert len(recording.steps) + sum(problem.lines for problem in recording.problems) == present


@given(raw=st.binary(max_size=2000), name=st.sampled_from(FILES), is_folder=st.booleans())
@examples(150)
def test_random_bytes_are_refused_in_one_line(tmp_path_factory, raw, name, is_folder):
    folder = tmp_path_factory.mktemp("fuzz")
    head = b"\x1f\x8b\x08\0" if name.endswith("gz") else b""
    (folder / name).write_bytes(head + raw)
    refused(read_recording, folder if is_folder else folder / name)


@given(cut=st.floats(0, 1), changes=edits)
@examples(60)
def test_a_damaged_metrics_file_is_read_or_refused(tmp_path_factory, cut, changes):
    text = damaged(made.training_metrics(ROWS), changes)
    file: Path = tmp_path_factory.mktemp("fuzz") / "TrainingMetrics.json"
    file.write_text(text[: int(cut * len(text))], newline="")
    recording = read_or_refused(file)
    assert recording is None or len(recording.metrics) <= 3
