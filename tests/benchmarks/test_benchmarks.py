"""The benchmarks measure what they say; how fast anything is, is not tested here."""

import json
from pathlib import Path

import pytest

from benchmarks import all_tracks, sb3_peer, throughput, time_to_lap
from benchmarks.driving import SameDriving, scalar_setup
from benchmarks.report import median, table
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


def test_bare_physics_and_environment_drive_the_same_way_every_time(experiment: Experiment) -> None:
    same = SameDriving(experiment, 3)
    ended = []
    for _ in range(2):
        assert same.env_pass_s() > 0
        ended.append(same._env.race.state_arrays()["physics_state"])
        assert same.physics_pass_s() > 0  # asserts the state it ends in
    assert (ended[0] == ended[1]).all()
    assert (ended[0] == same._last).all()


def test_the_scalar_reward_is_the_experiments_without_its_batch_form(experiment: Experiment) -> None:
    text = scalar_setup(experiment).reward.text
    assert "def reward_function" in text
    assert "reward_batch" not in text


def test_throughput_tells_the_documented_figures_and_holds_the_training_against_the_faster_peer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rates = {
        "physics": [100.0, 100.0, 200.0],
        "env": [80.0, 50.0, 180.0],
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
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "tracks.json"
    arguments = ["Oval_track", *SHORTEST, "stopping.lap_share=1.0", "budget.env_steps=1024"]
    all_tracks.main(["--json", str(file), "--markdown", *arguments])
    (row,) = json.loads(file.read_text())["tracks"]
    assert row["track"] == "Oval_track"
    assert (row["env_steps"], row["reliable_steps"], row["best_lap_time_s"]) == (1024, None, None)
    head, _, line = capsys.readouterr().out.splitlines()
    assert head.startswith("| track")
    assert "not in 1,024 (0%)" in line


def test_what_never_happened_took_longer_than_anything() -> None:
    assert median([3.0, None, 1.0]) == 3.0
    assert median([None, None, 1.0]) is None
    assert median([1.0, None]) is None


def test_the_columns_of_a_table_stand_below_one_another() -> None:
    lines = table(("a", "number"), [("long word", "1"), ("b", "1,000")]).splitlines()
    assert len({len(line) for line in lines}) == 1
