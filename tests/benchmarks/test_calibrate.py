"""Windows cut from recordings, a car driven through them, a car fitted to them."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from pydantic import TypeAdapter

from benchmarks import calibrate
from benchmarks.replay import WARM_UP_STEPS, cut_windows, errors, replay
from deepracer_exp.config.car import CarConfig
from deepracer_exp.deepracer.recording_reader import read_recording
from deepracer_exp.sim.batch import CarBatch

CONF = Path(__file__).parents[2] / "conf/car"
CAR = TypeAdapter(CarConfig).validate_python(yaml.safe_load((CONF / "deepracer.yaml").read_text()))
TRACES = Path(__file__).parents[3] / "shared/reference/console_training/sim-trace/training/training-simtrace"


def record(car: CarConfig, cars: int = 20, episodes: int = 4, rows: int = 35) -> pd.DataFrame:
    """Let cars drive and write down what the service would: one worker a car, one iteration an episode."""
    rng = np.random.default_rng(0)
    batch, everyone, tables = CarBatch(car, cars, 1), np.arange(cars), []
    for episode in range(episodes):
        # Putting a car down leaves its wheels turned.
        batch.lift(everyone, *rng.uniform(-3, 3, (3, cars)))
        for row in range(rows):
            speed = rng.choice([1.0, 2.0], cars)
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


def test_windows_begin_where_the_car_begins_to_move_and_every_second_from_there(recorded):
    windows = cut_windows(recorded, CAR.front_point_m, 15)
    assert len(windows) == 20 * 4 * 2
    assert windows.standing.tolist() == [True, False] * 80
    # The start of the second window is the end of the first.
    np.testing.assert_allclose(windows.truth[0, -1, :2], windows.start[1, :2])
    np.testing.assert_array_equal(windows.action[0, WARM_UP_STEPS:], windows.action[1, :WARM_UP_STEPS])


def test_what_comes_before_a_standing_start_is_the_same_cars_episode_before(recorded):
    windows = cut_windows(recorded, CAR.front_point_m, 15)
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


def test_a_fitted_value_that_no_car_has_is_named_with_the_bound_it_breaks():
    assert calibrate.unphysical(CAR, calibrate.PARAMETERS) == []
    (line,) = calibrate.unphysical(dataclasses.replace(CAR, tyre_friction=9.04), calibrate.PARAMETERS)
    assert line.startswith("unphysical: tyre_friction 9.04 is above 1.5;")


def test_a_car_predicts_its_own_recording(recorded):
    windows = cut_windows(recorded, CAR.front_point_m, 15)
    off = errors(replay(CAR, windows), windows).distance_m[:, -1]
    # From a standing start all is known; under way the motion has to be found from the poses.
    known = windows.standing & (windows.iteration == 0)
    assert off[known].max() < 2e-3
    assert np.median(off) < 0.02


def test_a_car_that_steers_later_does_not_predict_it(recorded):
    windows = cut_windows(recorded, CAR.front_point_m, 15)
    late = dataclasses.replace(CAR, servo_damping_nms=2 * CAR.servo_damping_nms)
    off = errors(replay(late, windows), windows).distance_m[:, -1]
    assert np.median(off) > 0.04


def test_predictions_do_not_depend_on_the_other_windows(recorded):
    windows = cut_windows(recorded, CAR.front_point_m, 15)
    some = np.array([3, 8, 9, 40])
    np.testing.assert_array_equal(replay(CAR, windows)[some], replay(CAR, windows.choose(some)))


def test_a_heading_is_wrong_by_half_a_turn_at_most(recorded):
    windows = cut_windows(recorded, CAR.front_point_m, 15)
    turned = windows.truth + np.array([0.0, 0.0, 4 * np.pi + 0.1])
    np.testing.assert_allclose(errors(turned, windows).yaw_rad, 0.1)


def test_a_fit_finds_the_parameters_of_the_car_that_was_recorded(recorded):
    windows = cut_windows(recorded, CAR.front_point_m, 15)
    wrong = dataclasses.replace(CAR, steering_trim_deg=3.0, servo_damping_nms=1.6 * CAR.servo_damping_nms)
    fitted_keys = ("steering_trim_deg", "servo_damping_nms")
    parameters = [p for p in calibrate.PARAMETERS if p.key in fitted_keys]
    some = np.flatnonzero(~calibrate.held_out(windows.iteration))[::3]
    found = calibrate.fit(wrong, windows.choose(some), parameters, 6)
    assert found.steering_trim_deg == pytest.approx(CAR.steering_trim_deg, abs=0.2)
    assert found.servo_damping_nms == pytest.approx(CAR.servo_damping_nms, rel=0.1)
    # What was not to be fitted is as it was.
    assert dataclasses.replace(found, **{key: getattr(CAR, key) for key in fitted_keys}) == CAR


@pytest.mark.parametrize(("iterations", "held"), [(28, [3, 7, 11, 15, 19, 23, 27]), (3, [2]), (1, [0])])
def test_every_fourth_iteration_is_held_out_or_the_last_of_few(iterations, held):
    assert np.flatnonzero(calibrate.held_out(np.arange(iterations))).tolist() == held


def write(recorded: pd.DataFrame, folder: Path) -> Path:
    """Write one car's drives as the service does."""
    for iteration, rows in recorded.groupby("iteration"):
        table = pd.DataFrame(
            {name: rows[name] for name in ("episode", "steps", "X", "Y", "yaw", "steer", "throttle")}
        )
        table = table.assign(
            action=0, reward=1.0, done=False, all_wheels_on_track=True, progress=1.0, closest_waypoint=1
        ).assign(track_len=17.7, tstamp=0.0, episode_status=rows["episode_status"], pause_duration=0.0)
        table.to_csv(folder / f"{iteration}-iteration.csv", index=False)
    return folder


def test_the_command_reports_both_parts_and_writes_a_car_that_can_be_chosen(
    recorded, tmp_path, capsys, monkeypatch
):
    # Episodes of all cars become one car's.
    rows = recorded.assign(episode=recorded.groupby(["iteration", "worker"], sort=False).ngroup())
    traces = write(rows, tmp_path)
    monkeypatch.setattr(calibrate, "PARAMETERS", calibrate.PARAMETERS[-1:])
    (tmp_path / "conf/car").mkdir(parents=True)
    output = tmp_path / "conf/car/mine.yaml"
    arguments = ["--traces", str(traces), "--output", str(output), "--evaluations", "1", "--windows", "20"]
    assert calibrate.main(arguments) == 0
    told = capsys.readouterr().out
    assert "held-out iterations" in told
    assert "steering_trim_deg" in told
    values = yaml.safe_load(output.read_text())
    assert values["name"] == "mine"
    monkeypatch.chdir(tmp_path)
    assert calibrate.car_named("mine").name == "mine"


@pytest.mark.parametrize(
    ("arguments", "told"),
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
    recorded, tmp_path, capsys, monkeypatch, arguments, told
):
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    Path("few").mkdir()
    write(recorded[recorded["worker"] == 3], Path("few"))
    assert calibrate.main(arguments) == 2
    error = capsys.readouterr().err.strip()
    assert told in error
    assert "\n" not in error
    assert not Path("missing").exists()


@pytest.mark.skipif(not TRACES.is_dir(), reason="the recordings of the AWS console are not here")
def test_the_fitted_car_predicts_held_out_recordings_and_the_bicycle_does_not(tmp_path):
    from benchmarks.fidelity import bicycle

    for iteration in (11, 23):
        shutil.copy(TRACES / f"{iteration}-iteration.csv", tmp_path)
    windows = cut_windows(read_recording(tmp_path).steps, CAR.front_point_m, 15)
    off = errors(replay(CAR, windows), windows).distance_m[:, -1]
    assert np.median(off) < 0.08
    assert np.median(off) < 0.2 * np.median(errors(bicycle(CAR, windows), windows).distance_m[:, -1])
