"""The benchmark of the start counts what it says; how fast a start is, is not tested here."""

import numpy as np
import pytest

from benchmarks.start import has_stepped, has_trial, packages_of, ratio

LINES = """\
import time: self [us] | cumulative | imported package
import time:       200 |        200 |     torch._C
import time:       300 |        500 |   torch
run: re:Invent 2018
import time:        50 |        550 | deepracer_exp.training.run
 25% · iteration 1 · 1,024 steps
import time:       900 |        900 | matplotlib
import time:       100 |        100 | torch.later
"""


def test_a_module_counts_once_and_for_its_package():
    found = packages_of(LINES.splitlines())
    assert [(each.name, each.modules, round(each.seconds, 6), each.is_later) for each in found] == [
        ("matplotlib", 1, 9e-4, True),
        ("torch", 3, 6e-4, False),
        ("deepracer_exp", 1, 5e-5, False),
    ]


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


def test_a_ratio_comes_with_an_interval_that_holds_it():
    of_same = ratio([2.0, 2.0, 2.0], [1.0, 1.0, 1.0])
    assert of_same == {"ratio": 0.5, "low": 0.5, "high": 0.5}
    uneven = ratio([4.0, 5.0, 6.0], [2.0, 4.0, 3.0])
    assert uneven["ratio"] == pytest.approx(0.6)
    assert uneven["low"] < uneven["ratio"] < uneven["high"]
