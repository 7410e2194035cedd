"""What is read if a checkpoint is not as it was written."""

import copy
import functools
import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from deepracer_exp.runs.checkpoint_files import pin, write_hashes
from deepracer_exp.runs.checkpoints import CheckpointStore, intact_checkpoint, read_checkpoint
from tests.conftest import refused

from .agents import TINY, make_agent

STATE = {"cars": torch.arange(6.0), "streams": {"seed": 3}}


@pytest.fixture(scope="module")
def four(tmp_path_factory) -> Path:
    """Checkpoints 10, 20, 30 and 40; 20 is the best, 40 the last, and no training can resume from 30."""
    store = CheckpointStore(tmp_path_factory.mktemp("run"), keep=4)
    for iteration in (10, 20, 30, 40):
        counters = {"iteration": iteration, "env_steps": 1000 * iteration}
        training = None if iteration == 30 else STATE
        store.save(make_agent(iteration), counters, training, best=iteration == 20)
    return store.folder


@pytest.fixture
def folder(four, tmp_path) -> Path:
    return Path(shutil.copytree(four, tmp_path / "run" / "checkpoints", symlinks=True))


def own(path: Path, name: str) -> Path:
    """Return a file of a checkpoint, wherever in it."""
    return next(file for file in sorted(path.rglob(name)) if "agent" in str(file) or file.parent == path)


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def empty(path: Path) -> None:
    shutil.rmtree(path)
    path.mkdir()


class Trap:
    """Leaves a folder behind when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("unpickled",)


def replace_by_pickle(path: Path) -> None:
    shutil.rmtree(path)
    path.write_bytes(pickle.dumps(Trap()))


def put_pickle_into(path: Path) -> None:
    own(path, "state.tdz").with_name("state.pt").write_bytes(pickle.dumps(Trap()))


def put_folder_beside(path: Path) -> None:
    shutil.copytree(own(path, "state.tdz").parent, path / "components" / "0002-more")


DAMAGES: dict[str, Callable[[Path], None]] = {
    "truncated archive": lambda path: os.truncate(own(path, "state.tdz"), 500),
    "empty archive": lambda path: os.truncate(own(path, "state.tdz"), 0),
    "archive flipped": lambda path: flip(own(path, "state.tdz")),
    "JSON flipped": lambda path: flip(own(path, "state.json")),
    "manifest flipped": lambda path: flip(path / "manifest.json"),
    "hashes flipped": lambda path: flip(path / "hashes.json"),
    "hashes truncated": lambda path: os.truncate(path / "hashes.json", 40),
    "hashes of no mapping": lambda path: (path / "hashes.json").write_text("[1]"),
    "hashes are text": lambda path: (path / "hashes.json").write_text('"x"'),
    "manifest missing": lambda path: (path / "manifest.json").unlink(),
    "hashes missing": lambda path: (path / "hashes.json").unlink(),
    "archive missing": lambda path: own(path, "state.tdz").unlink(),
    "JSON missing": lambda path: own(path, "state.json").unlink(),
    "training missing": lambda path: shutil.rmtree(next(path.rglob("*training"))),
    "training flipped": lambda path: flip(next(path.rglob("*training")) / "state.tdz"),
    "component added": put_folder_beside,
    "file added": lambda path: (path / "notes.json").write_text("{}"),
    "pickle added": put_pickle_into,
    "pickle in its place": replace_by_pickle,
    "empty folder": empty,
    "dangling link": shutil.rmtree,
}


@pytest.fixture(autouse=True)
def _nothing_is_unpickled(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    yield
    assert not Path("unpickled").exists()


refusal = functools.partial(refused, intact_checkpoint)


@pytest.mark.parametrize("damage", DAMAGES)
def test_the_newest_intact_checkpoint_replaces_a_corrupt_one_that_was_not_given_by_number(
    folder, damage, caplog
):
    for name, corrupt, newest in (("best", "000020", "000040"), ("last", "000040", "000030")):
        DAMAGES[damage](folder / corrupt)
        caplog.clear()
        assert intact_checkpoint(folder, name) == (folder / newest).resolve()
        (message,) = [record.message for record in caplog.records if record.name == "deepracer_exp"]
        assert f"checkpoint={name}" in message
        assert corrupt in message or f"/{name}:" in message
        assert f"using checkpoint {int(newest)}, the newest intact one" in message
        assert "\n" not in message
    refusal(folder, "20")
    assert intact_checkpoint(folder, "10").name == "000010"
    for name in ("000010", "000030"):
        # 30 holds only a policy, so nothing of a training can be corrupt there.
        (DAMAGES[damage] if "training" not in damage else DAMAGES["archive flipped"])(folder / name)
    for name in ("best", "last"):
        assert "is intact" in refusal(folder, name)


def test_intact_checkpoints_are_read_without_a_warning(folder, caplog):
    assert intact_checkpoint(folder, "best").name == "000020"
    assert intact_checkpoint(folder, "last").name == "000040"
    assert intact_checkpoint(folder, "000010").name == "000010"
    assert not caplog.records


def test_a_training_resumes_only_from_its_own_state(folder, caplog):
    flip(own(folder / "000040", "state.tdz"))
    assert intact_checkpoint(folder, "last").name == "000030"
    assert intact_checkpoint(folder, "last", resumable=True).name == "000020"
    assert "a training cannot resume" in caplog.text
    assert "a training cannot resume" in refusal(folder, "30", resumable=True)


def test_a_checkpoint_without_hashes_is_incomplete(folder):
    for path in folder.glob("0*"):
        (path / "hashes.json").unlink()
    for name in ("best", "last", "10"):
        assert "incomplete" in refusal(folder, name)


def test_a_link_out_of_the_folder_is_refused_with_others_intact(folder, four):
    for name, target in (("best", four / "000010"), ("last", folder.parent), ("best", Path())):
        (folder / name).unlink()
        (folder / name).symlink_to(target)
        assert "leads out of its folder" in refusal(folder, name)
    shutil.rmtree(folder / "000010")
    (folder / "000010").symlink_to(four / "000010")
    assert "leads out of its folder" in refusal(folder, "10")


def test_a_link_to_itself_leads_nowhere(folder, caplog):
    (folder / "best").unlink()
    (folder / "best").symlink_to("best")
    assert intact_checkpoint(folder, "best").name == "000040"
    assert "is a broken link" in caplog.text


def test_a_missing_last_is_the_newest_but_a_missing_best_is_refused(folder):
    (folder / "last").unlink()
    (folder / "best").unlink()
    assert intact_checkpoint(folder, "last").name == "000040"
    assert "40, 30" in refusal(folder, "best")
    shutil.rmtree(folder)
    assert "checkpoints: none" in refusal(folder, "last")


def test_checkpoints_are_compared_by_iteration_not_as_words(folder):
    CheckpointStore(folder.parent, keep=9).save(make_agent(0), {"iteration": 1_000_000}, STATE)
    flip(own(folder / "000020", "state.tdz"))
    assert intact_checkpoint(folder, "best").name == "1000000"


@pytest.mark.parametrize("how", ["links followed", "only the links' copies", "links as text"])
def test_a_run_copied_without_its_links_has_them_again(folder, tmp_path, how):
    copied = Path(shutil.copytree(folder, tmp_path / "moved" / "checkpoints"))
    for label, name in (("best", "000020"), ("last", "000040")):
        assert not (copied / label).is_symlink()
        if how == "links as text":
            shutil.rmtree(copied / label)
            (copied / label).write_text(name)
        elif how == "only the links' copies":
            shutil.rmtree(copied / name)
    assert intact_checkpoint(copied, "best") == copied / "000020"
    store = CheckpointStore(tmp_path / "moved", keep=4)
    store.save(make_agent(50), {"iteration": 50, "env_steps": 1}, STATE, best=True)
    for label in ("best", "last"):
        assert (copied / label).readlink() == Path("000050")


def test_a_best_that_is_no_copy_of_its_checkpoint_stays_as_it_is(folder, tmp_path):
    copied = Path(shutil.copytree(folder, tmp_path / "copy"))
    for manifest in ("{", "[]", '{"metadata": {"iteration": "../../up"}}', '{"metadata": {"iteration": -1}}'):
        (copied / "best" / "manifest.json").write_text(manifest)
        write_hashes(copied / "best")
        assert intact_checkpoint(copied, "last") == copied / "000040"
        assert (copied / "best").is_dir()
        assert not (copied / "best").is_symlink()


def test_unfinished_and_auxiliary_folders_are_not_checkpoints(folder):
    pin(folder, "000010", "promoted")
    shutil.copytree(folder / "000040", folder / ".000050")
    shutil.rmtree(folder / "000040")
    assert intact_checkpoint(folder, "last").name == "000030"


def test_a_well_hashed_checkpoint_of_another_kind_is_refused(folder):
    file = folder / "000010" / "manifest.json"
    manifest = json.loads(file.read_text())
    agent = manifest["components"]["agent"]
    changes = (
        {"components": {}},
        {"components": {**manifest["components"], "other": agent}},
        {"components": {"agent": {**agent, "adapter": "torchrl.dumps"}}},
        {"format": "foreign"},
    )
    others = [json.dumps(manifest | change).encode() for change in changes]
    for content in (*others, b"", b"{", b"[]", b'{"format": 1}', b"\xff\xfe"):
        file.write_bytes(content)
        write_hashes(folder / "000010")
        assert "not a checkpoint of deepracer-exp" in refusal(folder, "10")


@pytest.mark.parametrize("where", ["absolute", "..", "inside out", "link to a folder", "link to a file"])
def test_a_checkpoint_whose_files_lie_elsewhere_is_refused_although_its_hashes_fit(folder, where):
    path, other = folder / "000010", folder / "000020"
    manifest = json.loads((path / "manifest.json").read_text())
    part = manifest["components"]["agent"]["path"]
    if where.startswith("link"):
        target = path / part if where.endswith("folder") else path / part / "state.tdz"
        shutil.rmtree(target) if target.is_dir() else target.unlink()
        target.symlink_to(other / target.relative_to(path))
    else:
        elsewhere = {"absolute": str(other / part), "..": f"../000020/{part}"}
        manifest["components"]["agent"]["path"] = elsewhere.get(where, f"{part}/../../../000020/{part}")
        (path / "manifest.json").write_text(json.dumps(manifest))
    write_hashes(path)
    said = refusal(folder, "10")
    assert ("is a link; " if where.startswith("link") else "not a checkpoint of deepracer-exp") in said


def test_a_pickle_in_a_well_hashed_archive_is_refused_unread(folder):
    file = own(folder / "000010", "state.tdz")
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("other.pickle", pickle.dumps(Trap()))
    write_hashes(folder / "000010")
    assert "other.pickle, which is not a tensor; a pickle is never loaded" in refusal(folder, "10")
    file.write_bytes(pickle.dumps(Trap()))
    write_hashes(folder / "000010")
    assert "corrupt" in refusal(folder, "10")


@pytest.mark.parametrize("how", ["compressed", "shared"])
def test_an_archive_that_unpacks_to_more_than_it_has_is_refused_unread(folder, how):
    file = own(folder / "000010", "state.tdz")
    if how == "compressed":
        with zipfile.ZipFile(file, "a", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("tensor_900.memmap", bytes(2**26))
    else:  # two entries lead to the same bytes
        with zipfile.ZipFile(file, "a") as archive:
            one = next(member for member in archive.infolist() if member.filename.startswith("tensor"))
            for number in range(900, 990):
                again = copy.copy(one)
                again.filename = f"tensor_{number}.memmap"
                archive.filelist.append(again)
                archive._didModify = True
    write_hashes(folder / "000010")
    assert "unpack to" in refusal(folder, "10")


def test_a_checkpoint_of_gigabytes_is_refused_before_it_is_read(folder):
    file = own(folder / "000010", "state.tdz")
    os.truncate(file, 2**33)  # a sparse file
    assert "accepted: up to 4 GiB" in refusal(folder, "10")


def test_the_weights_are_those_of_the_replacement(folder):
    flip(own(folder / "000020", "state.tdz"))
    stored = read_checkpoint(TINY, folder, "best")
    assert stored.counters["iteration"] == 40
    for name, value in make_agent(40).state_dict()["networks"].items():
        assert torch.equal(value, stored.networks.state_dict()[name])
