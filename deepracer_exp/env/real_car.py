"""The physical car: what it can run."""

from deepracer_exp.config.experiment import Experiment

from .action_space import ContinuousActions, build_action_space

CAR_PICTURE = (160, 120)
"""Width and height of what the car's software shows a model."""


def car_refusals(experiment: Experiment) -> list[str]:
    """Return why the car could not run a policy of this experiment, or would show it something else; none: it can.

    Each is a line with key, value and what would be accepted. Sources: deepracer-custom-car 2.1.9.9, sensor_fusion_pkg
    and inference_pkg (one grey picture a frame, or two of a stereo pair), webserver_pkg (LIDAR),
    deepracer_navigation_pkg (ranges of continuous actions).

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
