"""Files that are never half written."""

import multiprocessing

from deepracer_exp.files import atomic_write


def write_often(path, letter):
    for _ in range(300):
        atomic_write(path, letter * 50_000)


def test_processes_that_write_the_same_file_do_not_disturb_each_other(tmp_path):
    path = tmp_path / "sweep.html"
    atomic_write(path, "")
    # No fork server: the first one of a process is the one that its trainings start workers from.
    spawned = multiprocessing.get_context("spawn")
    writers = [spawned.Process(target=write_often, args=(path, letter)) for letter in "abc"]
    for writer in writers:
        writer.start()
    while any(writer.is_alive() for writer in writers):
        text = path.read_text()
        assert text == text[:1] * len(text)
    assert [writer.exitcode for writer in writers] == [0, 0, 0]
    assert [one.name for one in tmp_path.iterdir()] == ["sweep.html"]
