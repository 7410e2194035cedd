import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.driving import OFF, QUANTITIES, RandomizationConfig
from deepracer_exp.config.parse import parse_experiment
from deepracer_exp.env.race import Race
from deepracer_exp.env.randomization.car_randomization import CarStreams
from deepracer_exp.env.setup import usual_cars
from deepracer_exp.env.trace_columns import PACKED
from deepracer_exp.errors import BadInput
from deepracer_exp.sim.batch import CarBatch
from tests.env.conftest import drive, make_setup, random_actions

DRAWN = [PACKED[name] for name in QUANTITIES]
REST = [place for name, place in PACKED.items() if name not in QUANTITIES]


def race_of(option: str = "none", *overrides: str, n_cars: int = 1, max_steps: int = 20, **ranges) -> Race:
    """Build a race whose cars stand at their starts, with other ranges than the option's."""
    setup = make_setup(f"randomization={option}", "action_space=continuous", *overrides)
    setup = dataclasses.replace(
        setup,
        randomization=dataclasses.replace(setup.randomization, **ranges),
        episode=dataclasses.replace(setup.episode, max_steps=max_steps),
    )
    race = Race(setup, n_cars)
    race.reset()
    return race


def drawn_of(race: Race, name: str) -> np.ndarray:
    return race.randomization.values[:, list(QUANTITIES).index(name)]


def by_episode(trace: np.ndarray) -> dict[tuple[int, int], np.ndarray]:
    """Return what each episode drew by (car, episode); an episode whose rows differ fails."""
    drawn: dict[tuple[int, int], np.ndarray] = {}
    for row in trace.reshape(-1, trace.shape[-1]):
        key = int(row[PACKED["car"]]), int(row[PACKED["episode"]])
        np.testing.assert_array_equal(drawn.setdefault(key, row[DRAWN]), row[DRAWN])
    return drawn


@pytest.fixture
def disturb_commands(monkeypatch) -> Callable[[Race], list]:
    """Record what reaches the cars of a race: steering in degrees, speed, and whether they may move."""

    def spy(race: Race) -> list:
        log, through = [], race._batch.drive

        def drive(speed_mps, steering_rad, moving):
            log.append((np.degrees(steering_rad), np.array(speed_mps), np.array(moving)))
            through(speed_mps, steering_rad, moving)

        monkeypatch.setattr(race._batch, "drive", drive)
        return log

    return spy


# --- What is drawn


def test_every_range_is_a_quantity_and_the_quantities_are_adjacent_columns_of_the_trace():
    keys = {field.name for field in dataclasses.fields(RandomizationConfig)}
    assert set(QUANTITIES) == keys - {"pictures", "real_car", "car_share"}
    assert np.diff(DRAWN).tolist() == [1] * (len(DRAWN) - 1)


def test_without_randomization_nothing_is_drawn(monkeypatch):
    def forbidden(*_):
        raise AssertionError("a random number was drawn")

    monkeypatch.setattr(CarStreams, "stream", forbidden)
    race = race_of(n_cars=2, max_steps=5)
    trace = drive(race, random_actions(12, 2))
    np.testing.assert_array_equal(trace[:, :, DRAWN], np.broadcast_to(list(OFF.values()), (12, 2, len(OFF))))


def test_an_episode_keeps_what_it_drew_and_the_next_one_draws_again():
    drawn = by_episode(drive(race_of("sim2real", n_cars=4), random_actions(100, 4)))
    assert len(drawn) > 12
    values, ranges = (
        np.array(list(drawn.values())),
        make_setup("randomization=sim2real", "action_space=continuous").randomization,
    )
    for column, name in enumerate(QUANTITIES):
        low, high = getattr(ranges, name)
        assert np.float32(low) <= values[:, column].min() <= values[:, column].max() <= np.float32(high)
        if name != "action_delay_steps":
            assert len(np.unique(values[:, column])) == len(drawn), name


def test_a_written_trace_reports_the_draws_as_they_were():
    values = race_of("sim2real", n_cars=4).randomization.values
    np.testing.assert_array_equal(values.astype(np.float32).astype(np.float64), values)


def test_an_episode_draws_the_same_whatever_happened_before():
    long, short = (
        by_episode(drive(race_of("sim2real", max_steps=steps, n_cars=3), random_actions(60, 3)))
        for steps in (20, 7)
    )
    both = long.keys() & short.keys()
    assert len(both) >= 9
    for key in both:
        np.testing.assert_array_equal(long[key], short[key])


def test_the_seed_decides_the_draws_and_seeding_begins_again():
    actions = random_actions(50, 2)
    first = drive(race_of("sim2real", n_cars=2), actions)
    race = race_of("sim2real", "seed=1", n_cars=2)
    assert not np.isin(drive(race, actions)[:, :, DRAWN[:4]], first[:, :, DRAWN[:4]]).any()
    race.seed(0)
    race.reset()
    np.testing.assert_array_equal(drive(race, actions), first)


@pytest.mark.parametrize(
    ("share", "fewest", "most"), [(0.0, 0, 0), (0.25, 15, 17), (0.5, 31, 33), (1.0, 64, 64)]
)
def test_a_share_of_the_cars_differs_and_the_others_drive_as_without_randomization(share, fewest, most):
    actions = random_actions(30, 64)
    some, none = (
        drive(race_of(option, n_cars=64, **keys), actions)
        for option, keys in (("sim2real", {"car_share": share}), ("none", {}))
    )
    as_configured = (some[:, :, DRAWN] == list(OFF.values())).all(axis=(0, 2))
    assert fewest <= np.count_nonzero(~as_configured) <= most
    np.testing.assert_array_equal(some[:, as_configured], none[:, as_configured])


def test_the_cars_of_a_race_differ_where_they_are_said_to():
    names = ("reinvent_base", "Oval_track", "Bowtie_track")
    setup = make_setup("randomization=mixed", "action_space=continuous", f"track=[{','.join(names)}]")
    race = Race(setup, 12)
    race.reset()
    plain = (race.randomization.values == list(OFF.values())).all(axis=1)
    np.testing.assert_array_equal(plain, usual_cars([1.0] * 3, 0.5, 12))
    parts = [Race(setup, 6, first_car=first) for first in (0, 6)]
    for part in parts:
        part.reset()
    drawn = np.concatenate([part.randomization.values for part in parts])
    np.testing.assert_array_equal(drawn, race.randomization.values)


def test_switching_one_quantity_off_leaves_the_draws_of_the_others():
    all_on = race_of("sim2real", n_cars=5).randomization.values
    off = {"mass_scale": (1.0, 1.0), "observation_noise": (0.0, 0.0)}
    some = race_of("sim2real", n_cars=5, **off).randomization.values
    same = [column for column, name in enumerate(QUANTITIES) if name not in off]
    np.testing.assert_array_equal(some[:, same], all_on[:, same])


def test_draws_are_uniform_and_every_delay_is_equally_likely():
    race = race_of(friction_scale=(0.5, 1.5), action_delay_steps=(1, 4), n_cars=3000)
    friction, delay = drawn_of(race, "friction_scale"), drawn_of(race, "action_delay_steps")
    deciles = np.quantile(friction, np.linspace(0, 1, 11))
    np.testing.assert_allclose(deciles, np.linspace(0.5, 1.5, 11), atol=0.05)  # five standard errors
    counts = np.bincount(delay.astype(int), minlength=6)
    np.testing.assert_allclose(counts, [0, 750, 750, 750, 750, 0], atol=120)
    assert abs(np.corrcoef(friction, delay)[0, 1]) < 0.08


# --- What reaches the car


def test_constant_noise_has_its_mean_and_deviation(disturb_commands):
    race = race_of("aws", steering_offset_deg=(-1.5, -1.5), n_cars=500)
    log, action = disturb_commands(race), np.zeros((500, 2))
    commanded_deg, commanded_mps = race.setup.actions.commands(action)
    for _ in range(8):
        race.step(action)
    steering = np.array([entry[0] for entry in log]) - commanded_deg
    speed = np.array([entry[1] for entry in log]) / commanded_mps
    # 4000 numbers: the mean is good to 1/63 of the deviation, the deviation to 1/90 of itself.
    assert steering.mean() == pytest.approx(-1.5, abs=0.13)
    assert steering.std() == pytest.approx(2.0, rel=0.05)
    assert speed.mean() == pytest.approx(1.0, abs=0.005)
    assert speed.std() == pytest.approx(0.07, rel=0.05)
    assert abs(np.corrcoef(steering.ravel(), speed.ravel())[0, 1]) < 0.07


def test_a_delayed_command_reaches_the_car_exactly_so_many_steps_later(disturb_commands):
    race = race_of(action_delay_steps=(0, 4), max_steps=12, n_cars=12)
    log, commanded, steps, delays = disturb_commands(race), [], [], []
    for action in random_actions(40, 12):
        commanded.append(race.setup.actions.commands(action))
        delays.append(drawn_of(race, "action_delay_steps").astype(int))
        race.step(action)
        steps.append(race.trace[:, PACKED["steps"]].astype(int))
        race.reset(np.flatnonzero(race.terminated | race.truncated))
    assert len(np.unique(delays)) == 5
    for t, car in itertools.product(range(40), range(12)):
        delay, (steering, speed, moving) = delays[t][car], log[t]
        assert moving[car] == (steps[t][car] > 1 + delay)
        if moving[car]:
            commanded_deg, commanded_mps = commanded[t - delay]
            assert steering[car] == pytest.approx(commanded_deg[car], abs=1e-12)
            assert speed[car] == commanded_mps[car]


def test_a_late_car_stands_until_its_first_command_arrives():
    race = race_of(action_delay_steps=(3, 3), n_cars=2)
    start = race.rules.now.front.copy()
    for _ in range(4):
        race.step(np.zeros((2, 2)))
        np.testing.assert_allclose(race.rules.now.front, start, atol=1e-6)
    race.step(np.zeros((2, 2)))
    assert (np.linalg.norm(race.rules.now.front - start, axis=1) > 1e-3).all()


def test_the_largest_delay_that_is_accepted_lets_a_car_drive():
    race = race_of(action_delay_steps=(13, 13), max_steps=0)
    for _ in range(25):
        race.step(np.zeros((1, 2)))
        assert not race.terminated
    with pytest.raises(BadInput, match=r"action_delay_steps reaches 14 .*immobilized_steps=15: .*up to 13"):
        compose_experiment(["randomization.action_delay_steps=[0,14]"])
    assert compose_experiment(["randomization.action_delay_steps=[0,15]", "episode.immobilized_steps=0"])


def test_a_battery_loses_its_share_of_the_speed_over_twenty_seconds_and_no_more(disturb_commands):
    race = race_of(battery_sag=(0.3, 0.3), max_steps=0)
    log = disturb_commands(race)
    commanded = race.setup.actions.commands(np.zeros((1, 2)))[1][0]
    for _ in range(320):
        race.step(np.zeros((1, 2)))
    share = np.array([entry[1][0] for entry in log[1:]]) / commanded
    assert share[0] == 1
    np.testing.assert_allclose(np.diff(share[:301]), -0.3 / 300, atol=1e-7)
    np.testing.assert_allclose(share[300:], 0.7, atol=1e-6)


def test_each_car_has_the_grip_the_mass_the_motors_and_the_servos_it_drew():
    scales = dict.fromkeys(("friction_scale", "mass_scale", "motor_scale", "servo_scale"), (0.5, 1.5))
    race = race_of("none", "track=reinvent_carpet", n_cars=5, **scales)
    cars, nominal = race._batch._cars, race._batch._car
    friction, mass, motor, servo = (drawn_of(race, name) for name in scales)
    floor = race.setup.track.floor.friction
    np.testing.assert_allclose(cars["friction"], friction * floor * nominal["friction"])
    np.testing.assert_allclose(cars["mass_scale"], mass)
    for name in ("mass_kg", "yaw_inertia_kgm2", "wheel_kg"):
        np.testing.assert_allclose(cars[name], mass * nominal[name])
    np.testing.assert_allclose(cars["motor_n"], motor * nominal["motor_n"])
    np.testing.assert_allclose(cars["steering_time_s"], nominal["steering_time_s"] / servo)


def test_the_physics_bears_every_corner_of_what_is_accepted():
    corners = np.array(list(itertools.product([0.1, 2.0], [0.5, 2.0], [0.5, 2.0], [0.5, 2.0])))
    car = compose_experiment([])[0].car
    cars, everyone = CarBatch(car, len(corners), 1), np.arange(len(corners))
    setters = (cars.set_friction_scale, cars.set_mass_scale, cars.set_motor_scale, cars.set_servo_scale)
    for scale, apply in zip(corners.T, setters, strict=True):
        apply(everyone, scale)
    draw = np.random.default_rng(3)
    for _ in range(60):
        cars.drive(draw.uniform(0.1, 4, len(corners)), np.radians(draw.uniform(-30, 30, len(corners))))
        state = cars.read()
        assert np.hypot(state.speed_mps, state.lateral_mps).max() < 4.5
        assert np.abs(state.yaw_rate_radps).max() < 12


# --- What the policy sees


def test_disturbed_observations_do_not_change_the_driving():
    actions = random_actions(50, 4)
    clear = drive(race_of(n_cars=4), actions)
    blurred = drive(race_of(observation_noise=(0.0, 0.5), observation_dropout=(0.0, 1.0), n_cars=4), actions)
    assert clear[:, :, PACKED["done"]].sum() > 4
    np.testing.assert_array_equal(clear[:, :, REST], blurred[:, :, REST])


def test_noise_is_on_what_is_measured_and_not_on_what_was_commanded():
    noisy, clear = race_of(observation_noise=(0.1, 0.1), n_cars=400), race_of(n_cars=400)
    away = [noisy.observation - clear.observation]
    for action in random_actions(9, 400):
        for race in (noisy, clear):
            race.step(action)
        away.append(noisy.observation - clear.observation)
    names = clear.feature_names
    known = [names.index("last_steering"), names.index("last_speed")]
    difference = np.array(away)
    assert not difference[:, :, known].any()
    measured = np.delete(difference, known, axis=2)
    # The first observation of an episode is as noisy as the others.
    for part in (measured[0], measured[1:]):
        assert part.mean() == pytest.approx(0, abs=0.006)
        assert part.std() == pytest.approx(0.1, rel=0.05)
    flat = measured.transpose(0, 2, 1).reshape(-1, 400)
    np.fill_diagonal(correlation := np.corrcoef(flat), 0)
    assert np.abs(correlation).max() < 0.35  # 14,365 pairs of 400: seven standard errors


def test_a_dropout_shows_the_last_observation_again_but_never_that_of_another_episode():
    race = race_of(observation_dropout=(1.0, 1.0), n_cars=3, max_steps=6)
    clear = race_of(n_cars=3, max_steps=6)
    for action in random_actions(20, 3):
        before = race.observation.copy()
        for each in (race, clear):
            each.step(action)
        np.testing.assert_array_equal(race.observation, before)
        ended = np.flatnonzero(race.terminated | race.truncated)
        for each in (race, clear):
            each.reset(ended)
        np.testing.assert_array_equal(race.observation[ended], clear.observation[ended])
        if len(ended):
            assert (race.observation[ended] != before[ended]).any()


def test_dropouts_come_as_often_as_was_drawn():
    race = race_of(observation_dropout=(0.0, 0.6), n_cars=60, max_steps=0)
    disturb_observation = [race.observation]
    for _ in range(200):
        race.step(np.zeros((60, 2)))
        disturb_observation.append(race.observation)
    repeated = (np.diff(np.array(disturb_observation), axis=0) == 0).all(axis=2)[
        2:
    ]  # a standing car repeats itself
    expected = drawn_of(race, "observation_dropout")
    np.testing.assert_allclose(repeated.mean(axis=0), expected, atol=0.15)
    assert repeated.mean() == pytest.approx(expected.mean(), abs=0.02)


# --- What is refused


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("friction_scale", [0, 1], r"\.0=0: .*greater"),
        ("friction_scale", [1, 2.5], r"\.1=2.5: .*less"),
        ("mass_scale", [1, 1e9], r"\.1=1000000000.0: .*less"),
        ("motor_scale", [1.2, 0.8], r"=\[1.2, 0.8\]: the first number of a range is the lowest"),
        ("servo_scale", [0.9], r"=\[0.9\]: .* at least 2 items"),
        ("servo_scale", [0.9, 1, 1.1], r"=\[0.9, 1, 1.1\]: .* at most 2 items"),
        ("servo_scale", 0.9, "=0.9: "),
        ("servo_scale", None, "=null: "),
        ("battery_sag", [0, 1.1], r"\.1=1.1: .*less"),
        ("action_delay_steps", [0, 16], r"\.1=16: .*less"),
        ("action_delay_steps", [-1, 1], r"\.0=-1: .*greater"),
        ("action_delay_steps", [0, 1.5], r"\.1=1.5: .*integer"),
        ("steering_offset_deg", [-20, 0], r"\.0=-20: .*greater"),
        ("steering_noise_deg", [-1, 0], r"\.0=-1: .*greater"),
        ("speed_noise", [0, float("nan")], r"\.1=NaN: .*finite"),
        ("observation_noise", [0, float("inf")], r"\.1=Infinity: .*finite"),
        ("observation_dropout", [0, 2], r"\.1=2: .*less"),
        ("observation_dropout", [0, "much"], r"\.1=\"much\": .*number"),
        ("camera_pitch_deg", [14, 16], "no such key"),
    ],
)
def test_a_silly_range_is_refused_in_one_line(mapping, name, value, complaint):
    silly = {**mapping, "randomization": {**mapping["randomization"], name: value}}
    with pytest.raises(BadInput, match=rf"^randomization\.{name}(: )?{complaint}") as caught:
        parse_experiment(silly)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def mapping():
    return compose_experiment([])[1].mapping
