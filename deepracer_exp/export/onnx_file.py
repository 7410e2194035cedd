"""A policy as an ONNX file: features of the observation in, what to drive out."""

import contextlib
import json
import logging
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from deepracer_exp.agents.actor_critic import ActorCritic
from deepracer_exp.env.action_space import ActionSpace, DiscreteActions
from deepracer_exp.errors import BadInput, RunFailed

OBSERVATION, POLICY, COMMAND = "observation", "policy", "command"
CHECKED = 1000
"""Observations on which the file is compared with the network."""
TOLERANCE = 1e-4
"""Largest difference that single precision in another order of sums explains, with room."""


class DeployedPolicy(nn.Module):
    """What a car needs of an actor-critic: no value, no sampling.

    `observation` (N, features) -> `policy`, the probabilities of the actions (N, n), of a continuous policy the mean
    of [steering, speed] clipped to -1..1 (N, 2); and `command` (N, 2), degrees (positive to the left) and metres per
    second: of the likeliest action, or of that mean.
    """

    def __init__(self, networks: ActorCritic, actions: ActionSpace):
        """Take the policy's layers over; `networks` must not learn on."""
        super().__init__()
        trunk = networks.trunk
        self.trunk = nn.Identity() if trunk is None else trunk.module
        self.head = networks.policy_head[0].module
        self.discrete = isinstance(actions, DiscreteActions)
        if isinstance(actions, DiscreteActions):
            rows = [actions.steering_deg, actions.speed_mps]
        else:
            rows = [actions.low, actions.high]
        table = np.stack(rows, axis=1 if self.discrete else 0)
        self.table: Tensor
        self.register_buffer("table", torch.as_tensor(table, dtype=torch.float32))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return policy and command."""
        outputs = self.head(self.trunk(observation))
        if self.discrete:
            policy = torch.softmax(outputs, dim=-1)
            return policy, self.table[policy.argmax(dim=-1)]
        policy = outputs[0].clamp(-1.0, 1.0)
        share = (policy + 1.0) * 0.5
        return policy, self.table[0] * (1.0 - share) + self.table[1] * share


@dataclass(frozen=True)
class Comparison:
    """How far the file is from the network."""

    observations: int
    largest_difference: float
    """Of any number of `policy`."""


def write_onnx(
    model: DeployedPolicy, features: tuple[str, ...], facts: Mapping[str, Any], path: Path
) -> Comparison:
    """Write the file and compare it with the network.

    Args:
        model: the policy.
        features: names of the numbers of an observation.
        facts: what the file should tell of itself, JSON types; written as its metadata.
        path: the file; written whole or not at all.

    Raises:
        BadInput: the packages for it are not installed, or the file cannot be written.
        RunFailed: the file computes something else than the network.
    """
    try:
        import onnx
        import onnxruntime  # noqa: F401 - looked for before the work
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise BadInput(
            f"format=onnx: needs the package {error.name}; install the project with its extra: "
            "pip install 'deepracer-exp[export]'"
        ) from error
    program = _program(model.eval(), len(features))
    onnx.helper.set_model_props(
        program,
        {"features": json.dumps(features), **{key: json.dumps(value) for key, value in facts.items()}},
    )
    content = program.SerializeToString()
    comparison = compare(model, content, len(features))
    if not comparison.largest_difference <= TOLERANCE:
        raise RunFailed(
            f"the ONNX file differs from the network by {comparison.largest_difference:.3g} on {CHECKED} observations; "
            f"at most {TOLERANCE:g} is rounding"
        )
    aside = path.with_name(f".{path.name}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        aside.write_bytes(content)
        aside.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            aside.unlink()
        raise BadInput(f"{path}: cannot be written: {error.strerror}") from error
    return comparison


def compare(model: DeployedPolicy, content: bytes, n_features: int) -> Comparison:
    """Run file and network on the same observations, standard normal ones: the features are of that size."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    observations = torch.randn(CHECKED, n_features, generator=torch.Generator().manual_seed(0))
    (theirs,) = session.run([POLICY], {OBSERVATION: observations.numpy()})
    with torch.no_grad():
        ours = model(observations)[0].numpy()
    return Comparison(CHECKED, float(np.abs(theirs - ours).max()))


def _program(model: DeployedPolicy, n_features: int) -> Any:
    """Return the ONNX model; the exporter's own talk is left out."""
    quiet = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    before = [logger.level for logger in quiet]
    for logger in quiet:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the libraries among themselves
            program = torch.onnx.export(
                model,
                (torch.zeros(2, n_features),),
                input_names=[OBSERVATION],
                output_names=[POLICY, COMMAND],
                dynamic_shapes={"observation": {0: torch.export.Dim("batch")}},
                dynamo=True,
                verbose=False,
            )
    finally:
        for logger, level in zip(quiet, before, strict=True):
            logger.setLevel(level)
    assert program is not None
    return program.model_proto
