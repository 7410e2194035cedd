import numpy as np
import pytest

from deepracer_exp.env.streams import CarStreams


def draw(streams: CarStreams, steps: int) -> np.ndarray:
    return np.array([streams.normal().copy() for _ in range(steps)])


def test_a_cars_numbers_depend_on_seed_and_car_alone():
    together = draw(CarStreams(7, range(6), 2), 300)
    np.testing.assert_array_equal(together[:, 4:], draw(CarStreams(7, [4, 5], 2), 300))
    np.testing.assert_array_equal(together[:, 3:4], draw(CarStreams(7, [3], 2), 300))


@pytest.mark.parametrize(("one", "other"), [((0, [1]), (1, [0])), ((0, [0]), (0, [1])), ((0, [0]), (1, [0]))])
def test_another_seed_or_car_gives_other_numbers(one, other):
    a, b = draw(CarStreams(*one, 2), 2000), draw(CarStreams(*other, 2), 2000)
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.06  # four standard errors


def test_no_number_comes_twice_across_the_blocks():
    numbers = draw(CarStreams(0, range(3), 2), 700)
    assert len(np.unique(numbers)) == numbers.size


def test_the_numbers_are_standard_normal():
    numbers = draw(CarStreams(3, range(20), 2), 1000)
    assert numbers.shape == (1000, 20, 2)
    assert abs(numbers.mean()) < 0.02
    assert abs(numbers.std() - 1) < 0.02
