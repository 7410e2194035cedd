"""The benchmark of the start counts what it says; how fast a start is, is not tested here."""

import numpy as np

from benchmarks.start import has_stepped, has_trial


def test_a_training_has_begun_to_drive_once_a_worker_has_counted_a_step(tmp_path):
    run = tmp_path / "runs" / "tiny" / "run"
    run.mkdir(parents=True)
    assert not has_stepped(tmp_path)
    for steps, driven in (([-1, -1], False), ([0, 0], False), ([0, 1], True)):
        np.array(steps, np.int64).tofile(run / ".heartbeat")
        assert has_stepped(tmp_path) == driven
    (run / ".heartbeat").unlink()
    assert not has_stepped(tmp_path)
    (run / "metrics.jsonl").touch()
    assert has_stepped(tmp_path)
    assert not has_trial(tmp_path)
    (run / "config.yaml").touch()
    assert has_trial(tmp_path)
