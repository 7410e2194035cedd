"""A policy as an ONNX file, compared with the network before it is written."""

import json
import logging
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from deepracer_exp.agents.actor_critic import PolicyNetworks, SensorNet
from deepracer_exp.agents.soft_actor_critic import SoftActorCritic
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.env.action_space import ActionSpace, DiscreteActions, build_action_space
from deepracer_exp.env.observation import feature_names, observation_shape
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.runs.stored_run import StoredRun

from .written import Written, checkpoint_line, write_file

POLICY, COMMAND = "policy", "command"
CHECKED, CHECKED_PICTURES = 1000, 100
"""Number of observations, without and with pictures, on which the file is compared with the network."""
TOLERANCE = 1e-4
"""Largest accepted difference, with a margin over single-precision rounding."""


def export_onnx(run: StoredRun, path: Path) -> Written:
    """Write the policy of a run as an ONNX file; arguments, result and errors as for `export.Writer`."""
    if path.is_dir():
        raise BadInput(f"--output {path}", f"is a folder; give a file, e.g. {path / 'policy.onnx'}")
    stored = run.read_policy()
    actions = build_action_space(run.experiment.action_space)
    torch.set_num_threads(1)
    facts: dict[str, Any] = {
        "run": run.path.name,
        "checkpoint": stored.path.name,
        "control_period_s": run.experiment.car.control_period_s,
    }
    observation = run.experiment.observation
    observed = observation_shape(observation)
    reads = []
    if observation.camera is not None:
        facts["camera"] = vars(observation.camera)
        channels, height, width = observation.camera.shape
        reads.append(f"pixels       pictures of {width}x{height} in bytes, channels: {channels}")
    if observation.lidar is not None:
        facts["lidar"] = vars(observation.lidar)
        reads.append(f"lidar        {observation.lidar.size} readings")
    if not reads:
        facts["features"] = feature_names(observation)
        reads.append(f"observation  {len(facts['features'])} features, named in the file's metadata")
    difference = write_onnx(DeployedPolicy(stored.networks, actions), observed, facts, path)
    what = f"probabilities of {actions.n} actions" if actions.n else "mean steering and speed, -1 to 1"
    checked = CHECKED if observation.camera is None else CHECKED_PICTURES
    return [path], [
        checkpoint_line(stored),
        *reads,
        f"policy       {what}",
        "command      steering in degrees, positive to the left; speed in m/s",
        f"checked      largest difference to the network {difference:.1e} on {checked:,} observations",
    ]


class DeployedPolicy(nn.Module):
    """The deterministic policy of an actor-critic, without value network and sampling.

    In: `observation` (N, features); or `pixels` (N, channels, height, width), bytes, and/or `lidar` (N, readings).
    Out: `policy`, the probabilities of the actions (N, n), or for a continuous policy the mean of [steering, speed]
    within -1..1 (N, 2), clipped or, of soft actor-critic, by its hyperbolic tangent; and `command` (N, 2), degrees
    (positive to the left) and metres per second, of the likeliest action or of that mean.
    """

    def __init__(self, networks: PolicyNetworks, actions: ActionSpace):
        """Share the layers of `networks`, which must not be trained further."""
        super().__init__()
        trunk = networks.trunk
        self.trunk = None if trunk is None else trunk.module
        self.head = networks.policy_head[0].module
        self.in_keys = list(networks.policy.in_keys)
        for module in self.modules():
            if isinstance(module, SensorNet):
                module.half_precision = False  # a file for any processor
        self.discrete = isinstance(actions, DiscreteActions)
        self.bounded = isinstance(networks, SoftActorCritic)
        if isinstance(actions, DiscreteActions):
            rows = [actions.steering_deg, actions.speed_mps]
        else:
            rows = [actions.low, actions.high]
        table = np.stack(rows, axis=1 if self.discrete else 0)
        self.table: Tensor
        self.register_buffer("table", torch.as_tensor(table, dtype=torch.float32))

    def forward(self, *observed: Tensor) -> tuple[Tensor, Tensor]:
        """Return policy and command."""
        outputs = self.head(*observed) if self.trunk is None else self.head(self.trunk(*observed))
        if self.discrete:
            policy = torch.softmax(outputs, dim=-1)
            return policy, self.table[policy.argmax(dim=-1)]
        policy = outputs[0].tanh() if self.bounded else outputs[0].clamp(-1.0, 1.0)
        share = (policy + 1.0) * 0.5
        return policy, self.table[0] * (1.0 - share) + self.table[1] * share


def write_onnx(
    model: DeployedPolicy, observed: ObservationShape, facts: Mapping[str, Any], path: Path
) -> float:
    """Write the file atomically and return its largest difference from the network on random observations.

    `facts` are metadata of the file, as JSON types.

    Raises:
        BadInput: the required packages are not installed, or the file cannot be written.
        RunFailed: the file differs from the network.
    """
    try:
        import onnx
        import onnxruntime  # noqa: F401 - missing packages are reported before the work
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise BadInput(
            "format=onnx",
            f"needs the package {error.name}; install the project with its extra: pip install 'deepracer-exp[export]'",
        ) from error
    observations = _observations(observed)
    program = _program(model.eval(), [values[:2] for values in observations])
    onnx.helper.set_model_props(program, {key: json.dumps(value) for key, value in facts.items()})
    content = program.SerializeToString()
    difference = largest_difference(model, content, observations)
    if not difference <= TOLERANCE:
        raise RunFailed(
            f"the ONNX file differs from the network by {difference:.3g} on {len(observations[0])} observations; "
            f"at most {TOLERANCE:g} is rounding"
        )
    write_file(path, content)
    return difference


def _observations(observed: ObservationShape) -> list[Tensor]:
    """Return random pictures, and standard normal features or readings, by the keys of `observed.seen` in order."""
    generator = torch.Generator().manual_seed(0)
    count = CHECKED if observed.picture is None else CHECKED_PICTURES
    return [
        torch.randint(0, 256, (count, *shape), generator=generator, dtype=torch.uint8)
        if key == "pixels"
        else torch.randn(count, *shape, generator=generator)
        for key, shape in observed.seen.items()
    ]


def largest_difference(model: DeployedPolicy, content: bytes, observations: Sequence[Tensor]) -> float:
    """Return the largest difference between the outputs `policy` of a file and of the network."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    inputs = {key: values.numpy() for key, values in zip(model.in_keys, observations, strict=True)}
    (theirs,) = session.run([POLICY], inputs)
    with torch.no_grad():
        ours = model(*observations)[0].numpy()
    return float(np.abs(theirs - ours).max())


def _program(model: DeployedPolicy, observations: Sequence[Tensor]) -> Any:
    """Return the ONNX model, with the exporter's own messages silenced."""
    quiet = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    before = [logger.level for logger in quiet]
    for logger in quiet:
        logger.setLevel(logging.ERROR)
    batch = torch.export.Dim("batch")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # between the libraries
            program = torch.onnx.export(
                model,
                tuple(observations),
                input_names=model.in_keys,
                output_names=[POLICY, COMMAND],
                dynamic_shapes={"observed": tuple({0: batch} for _ in observations)},
                dynamo=True,
                verbose=False,
            )
    finally:
        for logger, level in zip(quiet, before, strict=True):
            logger.setLevel(level)
    assert program is not None
    return program.model_proto
