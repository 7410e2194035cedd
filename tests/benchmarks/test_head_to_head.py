import json

import pytest

from benchmarks import head_to_head
from tests.conftest import IN_PROCESS


@pytest.mark.slow
def test_a_policy_races_against_the_one_it_began_with_and_those_on_the_way(tmp_path):
    options = ["--races", "2", "--work", str(tmp_path), "--json", str(tmp_path / "figures.json")]
    small = (
        *(line for line in IN_PROCESS if not line.startswith(("experiment=", "tracking="))),
        *("collector.cars=16", "budget.env_steps=null", "budget.iterations=2", "checkpoints.every=1"),
        *("algorithm.frames_per_iteration=512", "evaluation.time_s=4", "stopping=none"),
    )
    assert head_to_head.main([*options, *small]) == 0
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert 0 <= figures["began"]["won"] <= 1
    assert list(figures["checkpoints"]) == ["000001"]
