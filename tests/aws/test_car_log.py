"""Logs of a physical car's drive: bags as the car writes them, cut off, damaged, or of something else."""

import builtins
import contextlib
import shutil

import numpy as np
import pytest

from deepracer_exp.aws.logs.car_log import is_car_log, read_car_log
from deepracer_exp.errors import BadInput
from tests.aws.made_up_bags import BEGIN_NS, MESSAGES, SERVO, STEERING, drive_outputs, jpeg, write_bag
from tests.conftest import refused

pytest.importorskip("rosbags")

OLD_SERVO = {**MESSAGES, "ServoCtrlMsg": "float32 angle\nfloat32 throttle"}
STORAGES = ("sqlite3", "mcap")


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """The bag of a drive of 40 pictures in each storage, not to be changed."""
    folder = tmp_path_factory.mktemp("bags")
    return {storage: write_bag(folder / storage, drive_outputs(40), storage) for storage in STORAGES}


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_is_read_as_the_car_wrote_it(bags, storage):
    log = read_car_log(bags[storage])
    outputs = drive_outputs(40)
    assert log.name == storage
    assert log.is_discrete
    np.testing.assert_allclose(log.outputs, outputs, atol=1e-7)
    np.testing.assert_allclose(log.time_s, np.arange(40) / 30, atol=1e-6)
    np.testing.assert_allclose(log.steering, np.array(STEERING)[outputs.argmax(axis=1)])
    np.testing.assert_allclose(log.throttle, 0.4, atol=1e-7)
    np.testing.assert_allclose(log.latency_s, 0.02, atol=1e-9)
    assert log.pictures == tuple((jpeg(row),) for row in range(40))
    assert log.status["cpu_temp"].tolist() == [62.0, 62.0]
    assert log.problems == ()


@pytest.mark.parametrize("storage", STORAGES)
def test_a_file_alone_or_a_folder_with_one_bag_is_the_same_drive(bags, storage, tmp_path):
    shutil.copytree(bags[storage], tmp_path / "logs" / "drive")
    (file,) = (path for path in bags[storage].iterdir() if path.suffix != ".yaml")
    for place in (file, tmp_path / "logs"):
        assert is_car_log(place)
        assert read_car_log(place).pictures == read_car_log(bags[storage]).pictures


def test_a_folder_of_several_drives_names_them(bags, tmp_path):
    for name in ("first", "second"):
        shutil.copytree(bags["mcap"], tmp_path / name)
    assert is_car_log(tmp_path)
    assert "2 drives (first, second); accepted: one of them" in refused(read_car_log, tmp_path)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_log_that_was_cut_off_before_its_metadata_is_read(bags, storage, tmp_path):
    cut = shutil.copytree(bags[storage], tmp_path / "cut")
    (cut / "metadata.yaml").unlink()
    log = read_car_log(cut)
    assert len(log) == 40
    assert "cut off" in log.problems[0]


def test_commands_without_stamps_are_found_by_their_time(tmp_path):
    outputs = drive_outputs(20)
    bag = write_bag(
        tmp_path / "aws", outputs, commands=SERVO, stamped=False, status=False, messages=OLD_SERVO
    )
    log = read_car_log(bag)
    np.testing.assert_allclose(log.steering, np.array(STEERING)[outputs.argmax(axis=1)])
    assert log.status == {}


def test_a_drive_without_commands_says_so(tmp_path):
    log = read_car_log(write_bag(tmp_path / "bare", drive_outputs(5), commands=None))
    assert np.isnan(log.steering).all()
    assert any("no commands" in problem for problem in log.problems)


def test_outputs_that_are_no_probabilities_are_means(tmp_path):
    outputs = np.array([[0.3, -0.8], [0.5, 0.9]])
    log = read_car_log(write_bag(tmp_path / "means", outputs, steering=outputs[:, 0]))
    assert not log.is_discrete
    np.testing.assert_allclose(log.outputs, outputs, atol=1e-7)


def test_a_clock_that_is_set_during_a_drive_takes_no_years(tmp_path):
    taken = BEGIN_NS + np.arange(30) * 33_333_333
    taken[15:] += 5 * 365 * 86_400 * 10**9
    log = read_car_log(write_bag(tmp_path / "set", drive_outputs(30), taken_ns=taken))
    assert log.time_s[-1] == pytest.approx(29 / 30, abs=0.01)
    assert "clock was set" in log.problems[0]


def test_other_folders_and_files_are_no_logs_of_a_car(tmp_path):
    (tmp_path / "metadata.yaml").write_text("name: something else\n")
    (tmp_path / "trace.csv").write_text("episode,steps\n")
    for place in (tmp_path, tmp_path / "trace.csv", tmp_path / "missing"):
        assert not is_car_log(place)


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.7, 0.98])
def test_a_bag_that_is_cut_in_the_middle_is_read_or_refused_in_one_line(bags, storage, share, tmp_path):
    bag = shutil.copytree(bags[storage], tmp_path / "cut")
    (file,) = (path for path in bag.iterdir() if path.suffix != ".yaml")
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    read_or_refused(bag)
    (bag / "metadata.yaml").unlink()
    read_or_refused(bag)


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("seed", range(8))
def test_a_bag_with_wrong_bytes_is_read_or_refused_in_one_line(bags, storage, seed, tmp_path):
    bag = shutil.copytree(bags[storage], tmp_path / "wrong")
    (file,) = (path for path in bag.iterdir() if path.suffix != ".yaml")
    content = np.frombuffer(file.read_bytes(), np.uint8).copy()
    rng = np.random.default_rng(seed)
    content[rng.integers(0, len(content), 60)] = rng.integers(0, 256, 60)
    file.write_bytes(content.tobytes())
    read_or_refused(bag)


@pytest.mark.parametrize(
    "text", ["", "rosbag2_bagfile_information:\n  version: 99\n", "rosbag2_bagfile_information: [\n"]
)
def test_metadata_that_is_damaged_is_refused_in_one_line(bags, text, tmp_path):
    bag = shutil.copytree(bags["sqlite3"], tmp_path / "bag")
    (bag / "metadata.yaml").write_text(text)
    assert "damaged" in refused(read_car_log, bag)


def test_a_bag_without_its_file_is_refused_in_one_line(bags, tmp_path):
    (tmp_path / "bag").mkdir()
    shutil.copy(bags["mcap"] / "metadata.yaml", tmp_path / "bag")
    assert "missing" in refused(read_car_log, tmp_path / "bag")


def test_messages_of_another_layout_are_refused_and_never_become_code(tmp_path):
    other = {**MESSAGES, "InferResults": MESSAGES["InferResults"].replace("class_prob", "confidence_value")}
    line = refused(read_car_log, write_bag(tmp_path / "other", drive_outputs(3), messages=other))
    assert "its messages are not those of this version of the car" in line


def test_what_no_model_returns_is_refused(tmp_path):
    wrong = drive_outputs(3)
    wrong[1, 2] = np.nan
    assert "picture 1 are not finite" in refused(read_car_log, write_bag(tmp_path / "nan", wrong))
    bare = write_bag(tmp_path / "bare", np.zeros((2, 0)), steering=np.zeros(2))
    assert "not those of actions" in refused(read_car_log, bare)
    blind = write_bag(tmp_path / "blind", drive_outputs(2), cameras=0)
    assert "has no picture" in refused(read_car_log, blind)


def test_without_the_library_the_line_says_what_to_install(bags, monkeypatch):
    whole = builtins.__import__

    def without(name, *rest):
        if name.startswith("rosbags"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return whole(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    assert "pip install 'deepracer-exp[car]'" in refused(read_car_log, bags["mcap"])


def read_or_refused(bag):
    line = str(bag)
    with contextlib.suppress(BadInput):
        try:
            read_car_log(bag)
        except BadInput as error:
            line = str(error)
            raise
    assert "\n" not in line
    assert str(bag) in line
