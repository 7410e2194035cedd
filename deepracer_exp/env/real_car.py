"""The physical car: the policies it can run, its camera, steering and motor."""

import io
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from deepracer_exp.aws.models.car_controls import (
    full_scale,
    servo_value,
    speed_share,
    steering_share,
    throttle,
)
from deepracer_exp.config.evaluation import RealCarConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.errors import BadInput

from .action_space import ActionSpace, Commands, ContinuousActions, build_action_space, metadata_of

if TYPE_CHECKING:
    from .setup import RaceSetup

CAR_PICTURE = (160, 120)
"""Width and height of the pictures that the car's software passes to a model."""
FRAME_SCALE = 4
"""Width and height of the camera's frames over those of the picture."""
AS_SIMULATED, UNCOMPRESSED = -1, 0
"""In place of a JPEG quality: pictures of the simulator, and pictures of the car without compression."""

Floats = NDArray[np.float64]


def car_refusals(experiment: Experiment) -> list[str]:
    """Return why the car cannot run a policy of this experiment, or would feed it another observation.

    Each reason is a line with key, value and what would be accepted; the list is empty for a policy that it can run.
    Sources: deepracer-custom-car 2.1.9.9, sensor_fusion_pkg and inference_pkg (one grey picture a frame, or two of a
    stereo pair), webserver_pkg (LIDAR), deepracer_navigation_pkg (ranges of continuous actions).

    Raises:
        BadInput: a file of the action space is missing or malformed.
    """
    camera, lidar = experiment.observation.camera, experiment.observation.lidar
    refusals = []
    if camera is None and lidar is None:
        refusals.append(
            "observation: the car has no features of the road; accepted: policies of observation=camera, stereo, "
            "lidar or camera_lidar"
        )
    if camera is not None:
        if (camera.width, camera.height) != CAR_PICTURE:
            refusals.append(
                f"observation.camera: {camera.width}x{camera.height}; accepted: 160x120, what the car shows a model"
            )
        if camera.color != "grey":
            refusals.append(
                "observation.camera.color=rgb: the car shows a model grey pictures; accepted: grey"
            )
        if camera.frames != 1:
            refusals.append(
                f"observation.camera.frames={camera.frames}: the car shows a model one picture at a time; accepted: 1"
            )
    if lidar is not None:
        if lidar.kind == "discretized":
            refusals.append(
                "observation.lidar.kind=discretized: the car cannot load it; accepted: plain, sectors"
            )
        if abs(lidar.yaw_deg) != 180:
            refusals.append(
                f"observation.lidar.yaw_deg: {lidar.yaw_deg:g}; accepted: 180, as the service's car carries it"
            )
    actions = build_action_space(experiment.action_space)
    if isinstance(actions, ContinuousActions) and not (actions.low < actions.high).all():
        refusals.append(
            "action_space: a range of one value; accepted: low < high, else the car does not load the model"
        )
    return refusals


def require_car(experiment: Experiment, key: str = "evaluation.real_car") -> None:
    """Refuse a policy that the car cannot run, with the first of `car_refusals`; `key` asked for the car.

    Raises:
        BadInput: the car cannot run it.
    """
    for refusal in car_refusals(experiment):
        raise BadInput(key, f"the car cannot run this policy: {refusal}")


def as_the_car(setup: "RaceSetup", real_car: RealCarConfig) -> "RaceSetup":
    """Return a race in which cars see and act as the physical car does.

    Its physics steps are no longer than before, and the rules' limits stay the same in seconds.
    """
    setup = replace(setup, real_car=real_car)
    if real_car.timing is None:
        return setup
    car, episode, frames_per_s = setup.car, setup.episode, real_car.timing.frames_per_s
    ratio = frames_per_s / car.control_hz
    own_s = np.array([car.steering_delay_s, car.speed_delay_s])
    whole, rest = split_delay(own_s + real_car.timing.latency_s, 1 / frames_per_s)
    return replace(
        setup,
        car=replace(
            car,
            control_hz=frames_per_s,
            substeps=max(1, math.ceil(car.substeps / ratio)),
            steering_delay_s=float(rest[0]),
            speed_delay_s=float(rest[1]),
        ),
        late_steps=(int(whole[0]), int(whole[1])),
        episode=replace(
            episode,
            max_steps=round(episode.max_steps * ratio),
            immobilized_steps=round(episode.immobilized_steps * ratio),
            immobilized_m=episode.immobilized_m / ratio,
            reversed_steps=round(episode.reversed_steps * ratio),
        ),
    )


def split_delay(delay_s: Floats, period_s: float) -> tuple[NDArray[np.int64], Floats]:
    """Split delays into whole control periods, for the queue of commands, and the remaining seconds, for the car."""
    whole, rest_s = np.divmod(delay_s, period_s)
    return whole.astype(np.int64), rest_s


class Servos:
    """Steering servo and motor of N cars: their response to commands.

    The speed is taken to be proportional to the throttle; nothing is published on how the car's motor answers it.
    """

    def __init__(
        self,
        actions: ActionSpace,
        full_lock_deg: Floats,
        throttle_curve: Floats,
        full_throttle_mps: float | None = None,
    ) -> None:
        """Start centred.

        Args:
            actions: their largest angle is full lock, their fastest speed full throttle.
            full_lock_deg: of each car, (N,); 0: its commands are followed as they are. Later values count.
            throttle_curve: share of the car's throttle curve in that of each car, whose rest is proportional to the
                speed, (N,). Later values count.
            full_throttle_mps: speed at full throttle; None: that of the fastest action.
        """
        self._scale = full_scale(metadata_of(actions))
        self._full_lock_deg, self._throttle_curve = full_lock_deg, throttle_curve
        self._full_throttle_mps = full_throttle_mps or self._scale.speed_mps
        self.steering = np.zeros(len(full_lock_deg))
        """Angles as shares of full lock, (N,)."""

    def center(self, ids: NDArray[np.intp]) -> None:
        """Centre the steering of the cars `ids`."""
        self.steering[ids] = 0.0

    def follow(self, steering_deg: Floats, speed_mps: Floats) -> Commands:
        """Return the angles and speeds that commands lead to, each (N,)."""
        requested = steering_share(steering_deg, self._scale.steering_deg)
        self.steering = servo_value(requested, self.steering)
        curve, fastest_mps = self._throttle_curve, self._scale.speed_mps
        share = curve * throttle(speed_mps, fastest_mps) + (1 - curve) * speed_share(speed_mps, fastest_mps)
        is_servo = self._full_lock_deg > 0
        return (
            np.where(is_servo, self._full_lock_deg * self.steering, steering_deg),
            np.where(is_servo, self._full_throttle_mps * share, speed_mps),
        )


def car_pictures(frames: NDArray[np.uint8], jpeg_quality: ArrayLike) -> NDArray[np.uint8]:
    """Return the pictures that the car makes of its camera's frames for a model, (n, channels, height, width).

    The car compresses in colour and turns grey last; here it is the other way round: JPEG stores brightness separately,
    with the same weights of red, green and blue, so that the difference is rounding.

    Args:
        frames: grey, (n, channels, FRAME_SCALE * height, FRAME_SCALE * width).
        jpeg_quality: 1 to 100, or `UNCOMPRESSED`, for all or (n,).
    """
    # cv::resize, bilinear: between pixels 1 and 2 of each 4 by 4; the others are not used.
    rows = frames[..., 1::FRAME_SCALE, :].astype(np.uint16) + frames[..., 2::FRAME_SCALE, :]
    small = ((rows[..., 1::FRAME_SCALE] + rows[..., 2::FRAME_SCALE] + 2) >> 2).astype(np.uint8)
    for pictures, quality in zip(small, np.broadcast_to(jpeg_quality, len(small)).tolist(), strict=True):
        for picture in pictures if quality != UNCOMPRESSED else ():
            file = io.BytesIO()
            Image.fromarray(picture).save(file, "JPEG", quality=quality)
            picture[:] = np.asarray(Image.open(file))
    return small


def check_car(experiment: Experiment) -> None:
    """Refuse a policy that the car cannot load, or to which it would feed another observation.

    Raises:
        BadInput: naming the key and what would be accepted.
    """
    for refusal in car_refusals(experiment):
        raise BadInput(refusal)
    if experiment.observation.camera is None:
        raise BadInput(
            "observation.camera: null; a model of the service has a camera; accepted: observation=camera, stereo, "
            "camera_lidar"
        )
