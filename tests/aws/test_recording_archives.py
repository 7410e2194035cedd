"""Archives, alone and in folders, and logs that were packed one by one."""

import bz2
import gzip
import lzma
import resource
import stat
import tarfile
import zipfile
from pathlib import Path

import pytest

from deepracer_exp.aws.logs.reader import read_recording
from tests.conftest import refused

from . import made_up_logs as made

OTHER = {
    f"training-simtrace/{number}-iteration.csv": made.csv_text(made.drives([number], seed=90 + number))
    for number in range(3)
}


def test_an_archive_reaches_nothing_outside_and_leaves_nothing_behind(tmp_path):
    (tmp_path / "secret.csv").write_text(made.csv_text(made.drives([0])))
    path = tmp_path / "two" / "below" / "evil.tar.gz"
    path.parent.mkdir(parents=True)
    with tarfile.open(path, "w:gz") as archive:
        for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE):
            link = tarfile.TarInfo(f"0{kind.decode()}-iteration.csv")
            link.type, link.linkname = kind, str(tmp_path / "secret.csv")
            archive.addfile(link)
        for name in ("../../1-iteration.csv", f"{tmp_path}/2-iteration.csv"):
            made.add_member(archive, name, made.csv_text(made.drives([1 if "1-" in name else 2])).encode())
    before = sorted(tmp_path.rglob("*"))
    recording = read_recording(path)
    assert sorted(tmp_path.rglob("*")) == before
    assert len(recording.steps) == 12
    assert sum("a link" in problem.reason for problem in recording.problems) == 2
    assert all(file.is_relative_to(path) and ".." not in file.parts for file in recording.files)


def test_a_zip_archive_is_read_as_any_other_and_its_links_are_not_followed(tmp_path):
    path = made.write_zip(made.console(), tmp_path / "week one.ZIP")
    whole = read_recording(made.write_archive(made.console(), tmp_path / "week.tar.gz"))
    with zipfile.ZipFile(path, "a") as archive:
        link = zipfile.ZipInfo("model/9-iteration.csv")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, "/etc/passwd")
    recording = read_recording(path)
    assert recording.name == "week one"
    assert recording.steps.equals(whole.steps)
    assert recording.metrics.equals(whole.metrics)
    (problem,) = recording.problems
    assert str(problem) == f"{path}/model/9-iteration.csv: a link; not followed"
    (tmp_path / "in a folder").mkdir()
    path.rename(tmp_path / "in a folder" / path.name)
    assert len(read_recording(tmp_path / "in a folder").steps) == len(whole.steps)


@pytest.mark.parametrize("damage", ["cut", "encrypted", "empty"])
def test_a_zip_archive_that_cannot_be_read_is_refused_in_one_line(damage, tmp_path):
    path = made.write_zip(
        {"0-iteration.csv": made.csv_text(made.drives([0]))} if damage != "empty" else {}, tmp_path / "a.zip"
    )
    raw = bytearray(path.read_bytes())
    if damage == "encrypted":  # the flag in both of the archive's lists
        raw[6] |= 1
        raw[raw.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(raw[: len(raw) // 2] if damage == "cut" else raw)
    assert refused(read_recording, path).startswith(str(path))


def test_archives_in_a_folder_are_read_as_what_they_hold(tmp_path):
    folder = made.write_folder(made.settings("model_metadata.json"), tmp_path / "downloads")
    made.write_archive(made.console(), folder / "week-one.tar.gz")
    (folder / "other").mkdir()
    made.write_archive(OTHER, folder / "other" / "week-two.tgz")
    recording = read_recording(folder)
    assert not recording.problems
    assert len(made.training(recording)) == made.ROWS["console"] + 18
    assert [round_.name.rpartition("downloads/")[2].split("/")[0] for round_ in recording.rounds] == [
        "other",
        "week-one.tar.gz",
    ]
    streams = set(recording.steps["stream"].unique()) - {"training"}
    assert len(streams) == made.EVALUATIONS["console"]


@pytest.mark.parametrize("beside", ["week-one", "model"])
def test_what_lies_unpacked_beside_an_archive_is_read_once(beside, tmp_path):
    # The members' own folder is called model.
    files = made.console()
    made.write_archive(files, tmp_path / "week-one.tar.gz")
    made.write_folder(files, tmp_path / beside)
    recording = read_recording(tmp_path)
    assert len(made.training(recording)) == made.ROWS["console"]
    (problem,) = recording.problems
    reason = f"{len(files)} of {len(files)} files are not read: the same are unpacked beside it"
    assert str(problem) == f"{tmp_path / 'week-one.tar.gz'}: {reason}"


def test_what_is_missing_beside_an_archive_is_read_out_of_it(tmp_path):
    files = made.drfc_single()
    made.write_archive(files, tmp_path / "week-one.tar.gz")
    some = {name: text for name, text in files.items() if "training-simtrace/0-" in name}
    other = {name: text + "\n" for name, text in files.items() if "training-simtrace/2-" in name}
    assert len(some) == len(other) == 1
    made.write_folder(some | other, tmp_path / "elsewhere" / "model")
    whole = read_recording(tmp_path / "week-one.tar.gz")
    made.write_folder(some | other, tmp_path / "model")
    recording = read_recording(tmp_path / "week-one.tar.gz")
    assert len(recording.steps) == len(whole.steps)
    rest = read_recording(tmp_path)
    assert any(f"1 of {len(files)} files are not read" in problem.reason for problem in rest.problems), (
        rest.problems
    )


def test_a_copy_of_the_same_drives_is_reported_and_left_out(tmp_path):
    for name in ("week.tar.gz", "week (1).tar.gz"):
        made.write_archive(made.console(), tmp_path / name)
    recording = read_recording(tmp_path)
    once = read_recording(tmp_path / "week.tar.gz")
    for table in ("steps", "updates", "metrics"):
        assert len(getattr(recording, table)) == len(getattr(once, table)), table
    assert not recording.rounds
    assert any("steps are left out: copies of" in problem.reason for problem in recording.problems)


def test_names_of_members_count_as_unpacked_and_archives_are_no_workers(tmp_path):
    path = tmp_path / "a.tar"
    with tarfile.open(path, "w") as archive:
        for name, seed in (("x/0-iteration.csv", 1), ("./x/0-iteration.csv", 2)):
            made.add_member(archive, name, made.csv_text(made.drives([0], seed=seed)).encode())
    last = made.drives([0], seed=2)
    assert read_recording(path).steps["X"].tolist() == last["X"].tolist()
    for number in (1, 2):
        csv = {"training-simtrace/0-iteration.csv": made.csv_text(made.drives([0], seed=number))}
        made.write_archive(csv, tmp_path / "two" / f"{number}.tar.gz")
    recording = read_recording(tmp_path / "two")
    assert set(recording.steps["worker"]) == {0}
    assert len(recording.rounds) == 2


def test_logs_of_any_name_are_read_in_an_archive_packed_or_not(tmp_path):
    pieces = {
        "stdout": made.log_text(made.drives([0], seed=1)),
        "robomaker.txt": made.log_text(made.drives([0], seed=2)),
        "ROBOMAKER.LOG.1.GZ": made.log_text(made.drives([0], seed=3)),
    }
    for number, (name, text) in enumerate(pieces.items()):
        folder = tmp_path / str(number)
        folder.mkdir()
        with tarfile.open(folder / "LOGS.TAR.GZ", "w:gz") as archive:
            raw = text.encode()
            made.add_member(archive, name, gzip.compress(raw) if name.endswith("GZ") else raw)
        for place in (folder, folder / "LOGS.TAR.GZ"):
            recording = read_recording(place)
            assert len(recording.steps) == 6, (place, name)
            assert not recording.problems


def test_an_archive_of_metrics_alone_is_read(tmp_path):
    made.write_folder(made.training_csvs("sim-trace/training/training-simtrace"), tmp_path)
    metrics = {
        "metrics/training/training-20240101101010-a.json": made.training_metrics(made.whole_training())
    }
    made.write_archive(metrics, tmp_path / "rest.tar.gz")
    recording = read_recording(tmp_path)
    assert not recording.problems
    assert len(recording.metrics) == 6


@pytest.mark.processes
def test_a_folder_may_hold_more_archives_than_a_process_may_open(tmp_path):
    made.write_folder(made.drfc_single(), tmp_path)
    for number in range(60):
        made.write_archive({"agent/model.pb": "weights"}, tmp_path / f"model_{number}.tar.gz")
        csv = {"0-iteration.csv": made.csv_text(made.drives([0], seed=100 + number))}
        made.write_archive(csv, tmp_path / f"week-{number}.tar.gz")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    open_now = len(list(Path("/proc/self/fd").iterdir()))
    resource.setrlimit(resource.RLIMIT_NOFILE, (open_now + 20, hard))
    try:
        recording = read_recording(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert not recording.problems
    assert len(made.training(recording)) == made.ROWS["drfc_single"] + 60 * 6


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])
@pytest.mark.parametrize("alone", [True, False])
def test_logs_that_were_packed_one_by_one_are_read(pack, alone, tmp_path):
    ending = {gzip.compress: "gz", bz2.compress: "bz2", lzma.compress: "xz"}[pack]
    first, second = made.drives([0, 1], seed=1), made.drives([2, 3], seed=2)
    packed = tmp_path / f"robomaker.log.1.{ending}"
    packed.write_bytes(pack(made.log_text(first).encode()))
    if not alone:
        (tmp_path / "robomaker.log").write_text(made.log_text(second))
    recording = read_recording(packed if alone else tmp_path)
    assert not recording.problems
    assert recording.steps["episode"].tolist() == sorted([0, 1] * 6 if alone else [0, 1, 2, 3] * 6)


def test_a_model_for_the_car_is_no_log_and_an_incomplete_archive_is_reported(tmp_path):
    made.write_folder(made.drfc_single(), tmp_path)
    made.write_archive({"agent/model.pb": "weights"}, tmp_path / "carfile.tar.gz")
    assert not read_recording(tmp_path).problems
    incomplete = tmp_path / "week-one.tar.gz"
    model = tmp_path / "my-model.tar.gz"
    made.write_archive({"a.pb": "weights" * 9999, "z/0-iteration.csv": "x" * 9999}, model)
    model.write_bytes(model.read_bytes()[:90])
    made.write_archive(made.console(), incomplete)
    incomplete.write_bytes(incomplete.read_bytes()[:20])
    recording = read_recording(tmp_path)
    assert len(made.training(recording)) == made.ROWS["drfc_single"]
    for path in (incomplete, model):
        assert str(path) in "\n".join(map(str, recording.problems))
