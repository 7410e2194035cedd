"""Windows cut from recordings, a car driven through them, a car fitted to them."""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from benchmarks import calibrate
from benchmarks.recorded import BANDS, car_named, in_band, join, median_error, read_recorded, sample
from benchmarks.replay import PERIOD_S, WARM_UP_STEPS, Windows, cut_windows, errors, replay
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


def test_windows_begin_where_the_car_begins_to_move_and_every_second_from_there(windows):
    assert len(windows) == 20 * 4 * 2
    assert windows.standing.tolist() == [True, False] * 80
    # The start of the second window is the end of the first.
    np.testing.assert_allclose(windows.truth[0, -1, :2], windows.start[1, :2])
    np.testing.assert_array_equal(windows.action[0, WARM_UP_STEPS:], windows.action[1, :WARM_UP_STEPS])


def test_what_comes_before_a_standing_start_is_the_same_cars_episode_before(recorded, windows):
    first, second = windows.choose(windows.standing & (windows.iteration < 2)).action[:2]
    last = recorded[(recorded["worker"] == 0) & (recorded["iteration"] == 0)].tail(WARM_UP_STEPS)
    np.testing.assert_array_equal(second[:WARM_UP_STEPS, 0], last["throttle"])
    # Of the first episode of a folder nothing is known.
    assert windows.first[windows.iteration == 0].tolist() == [WARM_UP_STEPS, 0] * 20
    assert not np.array_equal(first, second)


def test_no_window_goes_over_a_place_where_the_car_was_put_elsewhere_or_paused(recorded):
    one = recorded[(recorded["worker"] == 0) & (recorded["iteration"] == 0)].reset_index(drop=True)
    assert len(cut_windows(one, CAR.front_point_m, 15)) == 2
    moved = one.copy()
    moved.loc[20:, "X"] += 5.0
    assert len(cut_windows(moved, CAR.front_point_m, 15)) == 1
    paused = one.copy()
    paused.loc[20, "episode_status"] = "pause"
    assert len(cut_windows(paused, CAR.front_point_m, 15)) == 1


def test_no_warm_up_goes_over_a_place_where_the_car_was_put_elsewhere_and_what_is_left_out_is_counted(
    recorded,
):
    two = recorded[(recorded["worker"] == 0) & (recorded["iteration"] < 2)].reset_index(drop=True)
    assert cut_windows(two, CAR.front_point_m, 15).left_out == 0
    # The end of the first episode is the warm-up of the second one's start.
    moved = two.copy()
    moved.loc[30:34, "X"] += 5.0
    windows = cut_windows(moved, CAR.front_point_m, 15)
    assert (len(windows), windows.left_out) == (2, 2)
    assert windows.standing.tolist() == [True, False]
    # A car may be put elsewhere after the prepare step of an episode that is shorter than a warm-up.
    short = pd.concat([two[:8], two[35:]], ignore_index=True)
    short.loc[0, ["X", "yaw"]] += [3.0, 170.0]
    windows = cut_windows(short, CAR.front_point_m, 15)
    assert (len(windows), windows.left_out) == (2, 0)
    steps_m = np.hypot(*np.diff(windows.pose[0, windows.first[0] : WARM_UP_STEPS, :2], axis=0).T)
    assert steps_m.max() < 0.5
    turned = two.copy()
    turned.loc[10:, "yaw"] += 120.0
    assert cut_windows(turned, CAR.front_point_m, 15).left_out == 2


def test_windows_under_way_begin_as_often_as_asked_and_never_before_a_whole_warm_up(recorded):
    windows = cut_windows(recorded, CAR.front_point_m, 15, every=1)
    assert len(windows) == 20 * 4 * (1 + 35 - 15 - 16)
    assert (windows.first[~windows.standing] == 0).all()
    assert len(np.unique(windows.episode)) == 20 * 4


def test_the_replay_drives_exactly_as_the_cars_of_the_environment_do(recorded, windows):
    windows = windows.choose(windows.standing & (windows.iteration == 0))
    batch = CarBatch(CAR, len(windows), 1)
    batch.place(np.arange(len(windows)), *windows.start.T)
    poses = []
    for step in range(WARM_UP_STEPS, WARM_UP_STEPS + 15):
        batch.drive(*windows.action[:, step].T)
        poses.append(batch.read()[:3])
    off = errors(np.stack(poses, axis=1).transpose(2, 1, 0), windows)
    replayed = errors(replay(CAR, windows), windows)
    np.testing.assert_allclose(replayed, off, atol=1e-9)
    # And as the cars that were recorded.
    assert off.distance_m.max() < 1e-9


def test_a_fitted_value_that_no_car_has_is_named_with_the_bound_it_breaks():
    assert calibrate.unphysical(CAR, calibrate.PARAMETERS) == []
    (line,) = calibrate.unphysical(dataclasses.replace(CAR, tyre_friction=9.04), calibrate.PARAMETERS)
    assert line.startswith("unphysical: tyre_friction 9.04 is above 2;")


def test_a_car_predicts_its_own_recording_and_one_that_steers_later_does_not(windows):
    late = dataclasses.replace(CAR, steering_time_s=CAR.steering_time_s + 0.2)
    # Under way the motion has to be found from the poses.
    own, other = (np.median(errors(replay(car, windows), windows).distance_m[:, -1]) for car in (CAR, late))
    assert own < 0.02
    assert other > 0.04


@pytest.mark.parametrize("stamped", ["at the start", "at the end", "at random"])
def test_a_step_lasts_as_long_as_the_stamps_that_the_distance_driven_follows_say(stamped):
    rng = np.random.default_rng(0)
    lasted_s = PERIOD_S * rng.uniform(0.7, 1.3, 800)
    ended_s = np.cumsum(lasted_s)
    began_s = ended_s - lasted_s
    random_s = PERIOD_S * (np.arange(800) + rng.uniform(-0.3, 0.3, 800))
    driven = pd.DataFrame({"steps": np.arange(800), "X": 2.0 * began_s}).assign(
        stream="training", worker=0, iteration=0, episode=0, Y=0.0, yaw=0.0, steer=0.0, throttle=2.0
    )
    stamps = {"at the start": began_s, "at the end": ended_s, "at random": random_s}
    driven = driven.assign(episode_status="in_progress", tstamp=stamps[stamped])
    windows = cut_windows(driven, CAR.front_point_m, 15)
    found_s = windows.duration_s[1:, WARM_UP_STEPS:].ravel()
    expected_s = np.full(800, PERIOD_S) if stamped == "at random" else lasted_s
    first = 1 + WARM_UP_STEPS
    np.testing.assert_allclose(found_s, expected_s[first : first + len(found_s)], rtol=0.05)


def test_predictions_do_not_depend_on_the_other_windows(windows):
    some = np.array([3, 8, 9, 40])
    np.testing.assert_array_equal(replay(CAR, windows)[some], replay(CAR, windows.choose(some)))


def test_a_heading_is_wrong_by_half_a_turn_at_most(windows):
    turned = windows.truth + np.array([0.0, 0.0, 4 * np.pi + 0.1])
    np.testing.assert_allclose(errors(turned, windows).yaw_rad, 0.1)


def chosen(*keys: str) -> list[calibrate.Parameter]:
    return [p for p in calibrate.PARAMETERS if p.key in keys]


def test_a_fit_finds_the_parameters_of_the_car_that_was_recorded_and_leaves_the_others(windows):
    wrong = dataclasses.replace(CAR, steering_trim_deg=3.0, tyre_friction=1.3 * CAR.tyre_friction)
    some = windows.choose(np.arange(0, len(windows), 2))
    found = calibrate.fit(wrong, some, chosen("steering_trim_deg", "tyre_friction"), 15)
    assert found.car.steering_trim_deg == pytest.approx(CAR.steering_trim_deg, abs=0.2)
    assert found.car.tyre_friction == pytest.approx(CAR.tyre_friction, rel=0.05)
    assert found.undetermined == ()
    assert dataclasses.replace(found.car, steering_trim_deg=CAR.steering_trim_deg) == dataclasses.replace(
        CAR, tyre_friction=found.car.tyre_friction
    )


def test_what_the_recordings_do_not_determine_is_named_and_kept_where_it_began():
    # Driving straight ahead says nothing about the tyres' sideways grip.
    straight = record(CAR, cars=10, episodes=2)
    straight["steer"] = 0.0
    windows = cut_windows(record_again(straight), CAR.front_point_m, 15)
    keys = ("front_tyre_across_ns_per_m", "drive_radius_m")
    wrong = dataclasses.replace(CAR, drive_radius_m=0.9 * CAR.drive_radius_m, steering_trim_deg=0.0)
    found = calibrate.fit(wrong, windows, chosen(*keys), 10)
    assert found.undetermined == ("front_tyre_across_ns_per_m",)
    assert found.car.front_tyre_across_ns_per_m == CAR.front_tyre_across_ns_per_m
    assert found.car.drive_radius_m == pytest.approx(CAR.drive_radius_m, rel=0.02)


def record_again(recorded: pd.DataFrame) -> pd.DataFrame:
    """Let cars without trim drive the actions of a recording from the places where its episodes begin."""
    car, parts = dataclasses.replace(CAR, steering_trim_deg=0.0), []
    for _, rows in recorded.groupby(["worker", "iteration"], sort=False):
        batch, driven = CarBatch(car, 1, 1), rows.copy()
        batch.place(0, 0.0, 0.0, 0.0)
        for at, (_, row) in enumerate(rows.iterrows()):
            state = batch.read()
            driven.loc[row.name, ["X", "Y", "yaw"]] = state.x_m[0] + car.front_point_m, state.y_m[0], 0.0
            if at:
                batch.drive(row["throttle"], np.radians(row["steer"]))
        parts.append(driven)
    return pd.concat(parts)


def test_a_sample_takes_as_many_windows_of_each_band_as_there_are(windows):
    there = [int(in_band(windows, band).sum()) for band in BANDS]
    some = sample(windows, 90, 0)
    taken = [int(in_band(some, band).sum()) for band in BANDS]
    assert sum(taken) == 90
    assert min(taken) >= min(*there, 30)
    assert len(sample(windows, 10**6, 0)) == len(windows)


def test_an_interval_resamples_episodes_and_not_windows():
    rng = np.random.default_rng(0)
    # All windows of an episode are equally wrong: many windows say no more than their few episodes.
    off = np.repeat(rng.uniform(0.0, 1.0, 10), 100)
    few = median_error(off, np.repeat(np.arange(10), 100))
    many = median_error(off, np.arange(1000))
    assert few.error_m == many.error_m
    assert few.interval_m[1] - few.interval_m[0] > 3 * (many.interval_m[1] - many.interval_m[0])


def test_episodes_of_several_recordings_keep_apart(windows):
    assert len(np.unique(join([windows, windows]).episode)) == 2 * len(np.unique(windows.episode))


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


def test_a_version_is_found_where_it_is_stated_and_where_it_is_not(reference):
    names = ("console_v5_reinvent_base.log.gz", "droa_v6_training.tar.gz", "console_v5_one_bot_ppo.tar.gz")
    found = read_recorded([reference / "race_pace" / name for name in names])
    assert [(one.version, one.stated) for one in found] == [(5, True), (6, True), (5, False)]


def test_each_evaluation_of_a_folder_is_a_recording_of_its_own(reference):
    both = read_recorded([reference / "console_training/sim-trace/evaluation"])
    assert len(both) == len({one.name for one in both}) == 2
    assert all(one.steps["stream"].nunique() == 1 for one in both)
    assert [one.version for one in both] == [4, 4]
