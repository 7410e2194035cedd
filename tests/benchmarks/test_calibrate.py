"""Windows cut from recordings, a car driven through them, a car fitted to them."""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from benchmarks import calibrate
from benchmarks.recorded import car_named
from benchmarks.replay import PERIOD_S, Windows, cut_windows
from deepracer_exp.config.car import CarConfig
from deepracer_exp.sim.batch import CarBatch

CAR = car_named("deepracer_v5")


def record(car: CarConfig, cars: int = 20, episodes: int = 4, rows: int = 35) -> pd.DataFrame:
    """Let cars drive and write down what the service would: one worker a car, one iteration an episode."""
    rng = np.random.default_rng(0)
    batch, everyone, tables = CarBatch(car, cars, 1), np.arange(cars), []
    for episode in range(episodes):
        # Putting a car down leaves its wheels turned.
        kept = batch._drives[["steering_rad", "sent_steering_rad"]].copy()
        batch.place(everyone, *rng.uniform(-3, 3, (3, cars)))
        batch._drives[["steering_rad", "sent_steering_rad"]] = kept
        for row in range(rows):
            speed = rng.choice([1.0, 2.0, 3.5], cars)
            steering_deg = rng.choice([-30.0, -10.0, 0.0, 20.0, 30.0], cars)
            state = batch.read()
            tables.append(
                pd.DataFrame(
                    {
                        "stream": "training",
                        "worker": everyone,
                        "iteration": episode,
                        "episode": episode,
                        "steps": row + 1,
                        "X": state.x_m + car.front_point_m * np.cos(state.yaw_rad),
                        "Y": state.y_m + car.front_point_m * np.sin(state.yaw_rad),
                        "yaw": np.degrees(state.yaw_rad),
                        "steer": steering_deg,
                        "throttle": speed,
                        "episode_status": "in_progress" if row else "prepare",
                        "tstamp": (episode * rows + row) * PERIOD_S,
                    }
                )
            )
            if row:
                batch.drive(speed, np.radians(steering_deg))
    table = pd.concat(tables, ignore_index=True)
    return table.sort_values(["worker", "iteration", "steps"], ignore_index=True)


@pytest.fixture(scope="module")
def recorded() -> pd.DataFrame:
    return record(CAR)


@pytest.fixture(scope="module")
def windows(recorded: pd.DataFrame) -> Windows:
    """Windows of a second."""
    return cut_windows(recorded, CAR.front_point_m, 15)


def chosen(*keys: str) -> list[calibrate.Parameter]:
    return [p for p in calibrate.PARAMETERS if p.key in keys]


def write(recorded: pd.DataFrame, folder: Path) -> Path:
    """Write one car's drives as the service does."""
    for iteration, rows in recorded.groupby("iteration"):
        table = pd.DataFrame(
            {name: rows[name] for name in ("episode", "steps", "X", "Y", "yaw", "steer", "throttle")}
        )
        table = table.assign(
            action=0, reward=1.0, done=False, all_wheels_on_track=True, progress=1.0, closest_waypoint=1
        ).assign(
            track_len=17.7, tstamp=rows["tstamp"], episode_status=rows["episode_status"], pause_duration=0.0
        )
        table.to_csv(folder / f"{iteration}-iteration.csv", index=False)
    return folder


def test_the_command_reports_the_errors_and_writes_a_car_that_can_be_chosen(
    recorded, tmp_path, capsys, monkeypatch
):
    # Episodes of all cars become one car's.
    rows = recorded.assign(episode=recorded.groupby(["iteration", "worker"], sort=False).ngroup())
    traces = write(rows, tmp_path)
    monkeypatch.setattr(calibrate, "PARAMETERS", chosen("steering_trim_deg", "steering_kick"))
    (tmp_path / "conf/car").mkdir(parents=True)
    output = tmp_path / "conf/car/mine.yaml"
    arguments = ["--traces", str(traces), "--car", "deepracer_v4", "--output", str(output)]
    assert calibrate.main([*arguments, "--evaluations", "4"]) == 0
    printed = capsys.readouterr().out
    assert "after one second, middle" in printed
    assert "0 left out" in printed
    monkeypatch.chdir(tmp_path)
    mine, base = car_named("mine"), car_named("deepracer_v4")
    assert mine.name == "mine"
    assert mine.steering_trim_deg != base.steering_trim_deg
    # The rest is the car's that it began with, and every value is explained.
    fitted = yaml.safe_load(output.read_text()).keys() - {"defaults"}
    assert dataclasses.replace(mine, **{key: getattr(base, key) for key in fitted}) == base
    lines = output.read_text().splitlines()
    assert all(lines[at - 1].startswith("#") for at, line in enumerate(lines) if line.startswith("steering"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--traces", "nowhere"], "nowhere: no such file or folder"),
        (["--traces", "empty"], "empty: no recorded steps"),
        (["--traces", "few"], "few: "),
        (["--traces", "few", "--car", "lorry"], "lorry"),
        (["--traces", "few", "--output", "missing/car.yaml"], "--output missing/car.yaml: cannot be written"),
        (["--traces", "few", "--output", "empty"], "--output empty: cannot be written"),
        (["--traces", "few", "--evaluations", "0"], "--evaluations 0"),
        (["--traces", "few", "--windows", "1"], "--windows 1"),
    ],
)
def test_bad_input_is_refused_in_one_line_before_the_fit(
    recorded, tmp_path, capsys, monkeypatch, arguments, words
):
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    Path("few").mkdir()
    write(recorded[recorded["worker"] == 3], Path("few"))
    assert calibrate.main(arguments) == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert "\n" not in error
    assert not Path("missing").exists()
