"""The benchmarks measure what they say; how fast anything is, is not tested here."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks import all_tracks, generalisation, sb3_peer, throughput, time_to_lap
from benchmarks.report import median
from benchmarks.throughput import PASS_STEPS, SameDriving, scalar_setup
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.tracks.track import world_track

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


def test_bare_physics_and_environment_drive_the_same_way_every_time(experiment: Experiment) -> None:
    same = SameDriving(experiment, 3)
    ended = []
    for _ in range(2):
        assert same.env_pass_s() > 0
        ended.append(same._env.race.state_arrays()["physics_state"])
        assert same.physics_pass_s() > 0  # asserts the state it ends in
    assert (ended[0] == ended[1]).all()
    assert len(same._noted) == PASS_STEPS


def test_the_scalar_reward_is_the_experiments_without_its_batch_form(experiment: Experiment) -> None:
    text = scalar_setup(experiment).reward.text
    assert "def reward_function" in text
    assert "reward_batch" not in text


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


def test_passes_are_measured_in_turns_each_for_its_seconds() -> None:
    calls = []

    def one_pass(name: str) -> tuple[float, float]:
        calls.append(name)
        return 10.0, 2.0

    rates = throughput.in_turns(2, 3.0, {"a": lambda: one_pass("a"), "b": lambda: one_pass("b")})
    assert calls == ["a", "a", "b", "b"] * 2
    assert rates == {"a": [5.0, 5.0], "b": [5.0, 5.0]}


def test_the_peer_trains_on_as_many_frames_as_the_experiment_has(experiment: Experiment) -> None:
    result = sb3_peer.measure(experiment, iterations=2, physics_threads=1, torch_threads=1)
    assert result["env_steps"] == 2 * (experiment.algorithm.frames_per_iteration or 0)
    assert result["steps_per_s"] > 0


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


def test_the_tracks_seen_and_unseen_follow_from_widths_alone() -> None:
    left_out = (
        "Straight_track",
        "reinvent_carpet",
        "reinvent_concrete",
        "reinvent_wood",
        "Monaco",
        "caecer_loop",
    )
    widths_m = {name: round(world_track(name).width_m, 3) for name in all_tracks.TRACKS}
    ordered = sorted(widths_m.keys() - set(left_out), key=lambda name: (widths_m[name], name))
    pairs = [ordered[place : place + 2] for place in range(0, len(ordered), 2)]
    seen = [pair[turn % 2] for turn, pair in enumerate(pairs)]
    assert tuple(seen) == generalisation.SEEN
    assert tuple(name for pair in pairs for name in pair if name not in seen) == generalisation.UNSEEN
    assert generalisation.ONE in seen


def test_a_policy_drives_every_track_both_ways_from_every_start(trained: Callable[..., Any]) -> None:
    run = trained("budget.iterations=1").folder
    both = generalisation.drive(run, ["Oval_track", "Bowtie_track"], starts=3)
    alone = generalisation.drive(run, ["Bowtie_track"], starts=3)
    assert both["Bowtie_track"] == alone["Bowtie_track"]
    for driven in both.values():
        assert 0 < driven.completion < 1
        assert driven.laps == 0


def test_generalisation_is_the_mean_over_seeds_and_tracks() -> None:
    def driven(seen: float, unseen: float) -> dict[str, generalisation.Driven]:
        lists = ((generalisation.SEEN, seen), (generalisation.UNSEEN, unseen))
        return {track: generalisation.Driven(share, share / 2) for tracks, share in lists for track in tracks}

    seeds = [
        {"six": driven(1.0, 0.9), "one": driven(0.8, 0.2)},
        {"six": driven(0.9, 0.6), "one": driven(0.6, 0.4)},
    ]
    summary = generalisation.summarize(seeds)
    assert (summary["unseen_completion"], summary["seen_completion"]) == (0.75, 0.95)
    assert summary["unseen_laps"] == 0.375
    assert (summary["one_track"]["unseen_completion"], summary["one_track"]["seen_completion"]) == (0.3, 0.7)
    assert [seed["six_tracks"]["unseen_completion"] for seed in summary["seeds"]] == [0.9, 0.6]
    assert [row["track"] for row in summary["tracks"] if row["seen"]] == list(generalisation.SEEN)
    assert "0.750" in generalisation.markdown(summary).splitlines()[-1]


def test_what_never_happened_took_longer_than_anything() -> None:
    assert median([3.0, None, 1.0]) == 3.0
    assert median([None, None, 1.0]) is None
    assert median([1.0, None]) is None
