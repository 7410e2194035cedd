import itertools

import numpy as np
import pytest

from deepracer_exp.env.randomization.car_randomization import CarStreams, Purpose, StepNoise


def noise(seed: int, cars, width: int = 2) -> StepNoise:
    return StepNoise(CarStreams(seed, cars, Purpose.ACTION), len(cars), width)


def draw(noise: StepNoise, steps: int) -> np.ndarray:
    return np.array([noise.normal().copy() for _ in range(steps)])


def test_a_cars_numbers_depend_on_seed_and_car_alone():
    together = draw(noise(7, range(6)), 300)
    np.testing.assert_array_equal(together[:, 4:], draw(noise(7, [4, 5]), 300))
    np.testing.assert_array_equal(together[:, 3:4], draw(noise(7, [3]), 300))


@pytest.mark.parametrize(("one", "other"), [((0, [1]), (1, [0])), ((0, [0]), (0, [1])), ((0, [0]), (1, [0]))])
def test_another_seed_or_car_gives_other_numbers(one, other):
    a, b = draw(noise(*one), 2000), draw(noise(*other), 2000)
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.06  # four standard errors


def test_every_stream_has_numbers_of_its_own():
    """The numbers of seed, purpose, car and stream are not interchangeable."""
    numbers = [
        CarStreams(seed, [car], purpose).stream(0, number).random(50)
        for seed, purpose, car, number in itertools.product((0, 1, 2), Purpose, (0, 1, 2), (0, 1, 2, 700))
    ]
    assert len(np.unique(numbers)) == np.size(numbers)


def test_a_stream_holds_the_same_whatever_was_drawn_before():
    streams = CarStreams(4, [3, 8], Purpose.EPISODE)
    first = streams.stream(1, 5).random(7)
    streams.stream(0, 5).integers(0, 9, 3)  # half a 64-bit number is left
    streams.stream(1, 4).standard_normal(1001)
    np.testing.assert_array_equal(streams.stream(1, 5).random(7), first)
    streams.stream(1, 4).integers(0, 9, 1, dtype=np.int32)
    whole = CarStreams(4, [8], Purpose.EPISODE).stream(0, 5).integers(0, 2**31, 5, dtype=np.int32)
    np.testing.assert_array_equal(streams.stream(1, 5).integers(0, 2**31, 5, dtype=np.int32), whole)


def test_no_number_comes_twice_across_the_blocks():
    numbers = draw(noise(0, range(3)), 700)
    assert len(np.unique(numbers)) == numbers.size


def test_the_numbers_are_standard_normal():
    numbers = draw(noise(3, range(20)), 1000)
    assert numbers.shape == (1000, 20, 2)
    assert abs(numbers.mean()) < 0.02
    assert abs(numbers.std() - 1) < 0.02


@pytest.mark.parametrize("steps", [1, 127, 128, 300])
def test_noise_continues_from_the_number_of_steps_drawn(steps):
    whole = draw(noise(2, range(3)), steps + 140)
    later = noise(2, range(3))
    later.steps = steps
    np.testing.assert_array_equal(draw(later, 140), whole[steps:])
