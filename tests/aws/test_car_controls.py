"""What the car makes of actions."""

import numpy as np
import pytest

from deepracer_exp.aws.models.car_controls import full_scale, servo_value, steering_share, throttle
from deepracer_exp.aws.models.model_metadata import Action, ModelMetadata


def test_half_speed_is_four_fifths_of_the_throttle_and_nothing_exceeds_it():
    np.testing.assert_allclose(throttle([0.0, 1.0, 2.0], 2.0), [0.0, 0.8, 1.0], rtol=1e-12)
    # The parabola has its top, 1.008, below full speed.
    assert throttle(1.8334, 2.0) == 1.0


def test_the_largest_angle_of_a_list_is_full_lock_whatever_its_side():
    metadata = ModelMetadata(actions=(Action(-20.0, 1.0), Action(0.0, 2.0), Action(10.0, 1.5)))
    scale = full_scale(metadata)
    assert scale == (20.0, 2.0)
    np.testing.assert_array_equal(steering_share([-20.0, 0.0, 10.0], scale.steering_deg), [-1.0, 0.0, 0.5])


def test_the_high_end_of_a_range_is_full_lock_and_what_exceeds_it_is_refused():
    scale = full_scale(ModelMetadata(low=Action(-27.0, 0.5), high=Action(25.0, 3.0)))
    assert scale == (25.0, 3.0)
    share = steering_share([-27.0, -25.0, 12.5], scale.steering_deg)
    assert share[0] < -1.0
    np.testing.assert_array_equal(servo_value(share, np.full(3, 0.3)), [0.3, -1.0, 0.5])


@pytest.mark.parametrize("full_lock_deg", [0.0, -5.0])
def test_without_an_angle_to_the_left_the_car_drives_straight_ahead(full_lock_deg):
    assert steering_share(-10.0, full_lock_deg) == 0.0
