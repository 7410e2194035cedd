"""The comparison of PPO, SAC and Stable-Baselines3's SAC asks each for the same, and takes figures from their runs."""

import json
from pathlib import Path

import pytest

from benchmarks import sac, sb3_timed
from deepracer_exp.config.compose import compose_experiment


def test_compared_trainings_begin_one_after_the_other_and_differ_by_the_algorithm_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def train(folder: Path, overrides: list[str], *minutes: float) -> dict[str, float | None]:
        asked.append((folder.name, overrides))
        seed = float(folder.name[-1])
        return dict.fromkeys(sac.FIGURES, 1.0) | {"steps": 600.0, "train_s": 2.0, "lap_time_s": 5.0 + seed}

    monkeypatch.setattr(sac, "ours", train)
    monkeypatch.setattr(sac, "peer", train)
    file = tmp_path / "sac.json"
    words = ["--seeds", "2", "--tracks", "Oval_track", "--jobs", "1", "--runs-dir", str(tmp_path)]
    assert sac.main([*words, "--json", str(file)]) == 0
    first = [name for name, _ in asked[:5]]
    assert first == [
        *(f"Oval_track-continuous-{algorithm}-0" for algorithm in ("ppo", "sac", "sb3_sac")),
        *(f"Oval_track-discrete_fast-{algorithm}-0" for algorithm in ("ppo", "sac")),
    ]
    assert asked[1][1] == asked[2][1]
    assert set(asked[0][1]) ^ set(asked[1][1]) == {"algorithm=ppo", "algorithm=sac"}
    rows = json.loads(file.read_text())["rows"]
    assert len(asked) == 2 * len(rows)
    assert rows[0]["lap_time_s"]["seeds"] == [5.0, 6.0]
    assert rows[0]["steps_per_s"]["iqm"] == 300.0
    assert "Oval_track, continuous, sb3_sac" in capsys.readouterr().out


@pytest.mark.parametrize("algorithm", ["sb3_sac", "sb3_ppo"])
def test_the_peer_trains_for_its_seconds_and_drives_laps(algorithm: str) -> None:
    overrides = sac.Asked("Oval_track", "continuous", algorithm).overrides(0.3, ["collector.cars=64"])
    found = sb3_timed.measure(compose_experiment(overrides)[0], seconds=0.3, trials=2)
    assert found["steps"] > 0
    assert found["train_s"] >= 0.3
    assert found["reliable_s"] is None
    assert 0 <= found["lap_share"] <= 1
    assert 0 < found["held_out_completion"] <= 100
