"""The benchmarks measure what they say; how fast anything is, is not tested here."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks import all_tracks, generalisation, throughput, time_to_lap
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.experiment import Experiment

# One process and one iteration; any 3 episodes count as reliable.
SHORTEST = (
    "experiment=tiny",
    "tracking=off",
    "collector=in_process",
    "collector.cars=16",
    "stopping=reliable",
    "stopping.lap_share=0.0",
    "stopping.episodes=3",
)


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return compose_experiment(["experiment=tiny", "collector=in_process", "collector.cars=16"])[0]


def test_throughput_reports_the_documented_figures_and_holds_the_training_against_the_faster_peer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rates = {
        "physics": [100.0, 100.0, 200.0],
        "env": [80.0, 50.0, 180.0],
        "env, all tracks": [72.0, 50.0, 90.0],
        "collect 1": [10.0, 10.0, 10.0],
        "collect 2": [15.0, 17.0, 19.0],
        "train": [30.0, 30.0, 30.0],
        throughput.peer_name(1, 1): [15.0, 15.0, 15.0],
        throughput.peer_name(2, 1): [20.0, 10.0, 30.0],
        throughput.peer_name(2, 2): [10.0, 40.0, 10.0],
    }
    monkeypatch.setattr(throughput, "cores", lambda: 2)
    summary = throughput.summarize(rates)
    assert summary["physics_steps_per_s"] == 100
    assert summary["env_steps_per_s"] == 80
    assert summary["collect_steps_per_s"] == {"1": 10, "2": 17}
    assert summary["train_steps_per_s"] == 30
    assert (summary["peer_sb3_train_steps_per_s"], summary["peer_torch_threads"]) == (20, 1)
    # The median of the rounds' ratios, not the ratio of the medians.
    assert summary["ratios"]["env_to_physics"] == {"median": 0.8, "min": 0.5, "max": 0.9, "wanted": 0.75}
    assert summary["ratios"]["all_tracks_over_one_env"]["median"] == 0.9
    assert summary["ratios"]["train_to_peer"]["median"] == 1.5
    assert summary["ratios"]["train_to_default_peer"]["median"] == 2
    assert "wanted" in throughput.show(summary)


def test_the_physics_alone_drives_what_the_cars_of_the_default_experiment_drove(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(throughput, "TRACKS", ("reinvent_base", "Oval_track"))
    rates = throughput.driving([], n_cars=4, rounds=1, seconds=0.0)
    assert set(rates) == {"physics", "env", "env, all tracks"}


@pytest.mark.slow
def test_time_to_lap_writes_its_figures_for_each_seed(tmp_path: Path) -> None:
    file = tmp_path / "lap.json"
    time_to_lap.main(["--seeds", "1", "--json", str(file), *SHORTEST])
    result = json.loads(file.read_text())
    (row,) = result["seeds"]
    assert set(row) == {"seed", "first_lap_s", "first_lap_steps", "reliable_s", "reliable_steps"}
    assert (row["seed"], row["first_lap_s"]) == (0, None)
    assert row["reliable_s"] == result["median_reliable_s"] > 0
    assert 1024 <= row["reliable_steps"] <= 4096


def test_all_tracks_writes_a_row_for_each_track_and_a_table(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    trained: Callable[..., Any],
) -> None:
    # A run of this process: the benchmark above starts one.
    overrides = ["budget.env_steps=1024"]
    run = trained("track=Oval_track", *overrides).folder
    asked = []
    monkeypatch.setattr(all_tracks, "train", lambda given, folder: asked.append(given) or run)
    file = tmp_path / "tracks.json"
    all_tracks.main(["--json", str(file), "--markdown", "Oval_track", *overrides])
    assert asked == [["track=Oval_track", "stopping=reliable", *overrides]]
    (row,) = json.loads(file.read_text())["tracks"]
    assert row["track"] == "Oval_track"
    assert (row["env_steps"], row["reliable_steps"], row["best_lap_time_s"]) == (1024, None, None)
    head, _, line = capsys.readouterr().out.splitlines()
    assert head.startswith("| track")
    assert "not in 1,024 (0%)" in line


def test_a_policy_drives_every_track_both_ways_from_every_start(trained: Callable[..., Any]) -> None:
    run = trained("budget.iterations=1").folder
    both = generalisation.drive(run, ["Oval_track", "Bowtie_track"], starts=3)
    alone = generalisation.drive(run, ["Bowtie_track"], starts=3)
    assert both["Bowtie_track"] == alone["Bowtie_track"]
    for driven in both.values():
        assert 0 < driven.completion < 1
        assert driven.laps == 0
