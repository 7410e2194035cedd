"""The command `export`: a policy as ONNX, for a car or as a model of the service; a run's files or logs for AWS."""

import json
import logging
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torch import Tensor, nn

from deepracer_exp.agents.actor_critic import ActorCritic, SensorNet
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.evaluation import ExportConfig
from deepracer_exp.env.action_space import ActionSpace, DiscreteActions, build_action_space
from deepracer_exp.env.observation import feature_names, observation_shape
from deepracer_exp.errors import BadInput, RunFailed, writing
from deepracer_exp.files import atomic_write, read_text
from deepracer_exp.lookup.resolve import StoredRun
from deepracer_exp.runs.checkpoints import StoredPolicy, read_checkpoint
from deepracer_exp.runs.files import EXPORTS, REWARD
from deepracer_exp.runs.recording import read_run_recording
from deepracer_exp.runs.result import read_result
from deepracer_exp.validation.aws_rules import text_findings

from .aws_files import aws_files, write_files
from .aws_logs import write_aws_logs
from .aws_model import aws_model
from .car_archive import ENDING, car_archive, describe_commands, name_on_car

POLICY, COMMAND = "policy", "command"
CHECKED, CHECKED_PICTURES = 1000, 100
"""Number of observations, without and with pictures, on which the file is compared with the network."""
TOLERANCE = 1e-4
"""Largest accepted difference, with a margin over single-precision rounding."""


def export(run: StoredRun, config: ExportConfig, output: str | None, out: Console) -> Path:
    """Export a run in the chosen format and print what was written.

    Raises:
        BadInput: the checkpoint or the output cannot be used, or a package is missing.
        RunFailed: the written file differs from the network.
    """
    names = {"onnx": "policy.onnx", "car": name_on_car(run.path.name) + ENDING}
    path = Path(output or run.path / EXPORTS / names.get(config.format, config.format))
    write = {"onnx": _onnx, "car": _car, "aws": _aws, "aws-model": _aws_model, "aws-logs": _aws_logs}
    files, lines = write[config.format](run, config, path)
    for line in (*map(str, files), *(f"  {line}" for line in lines)):
        out.print(line, soft_wrap=True)
    return path


_Written = tuple[Iterable[Path], list[str]]
"""Files or folders, and lines on them."""


def _stored(run: StoredRun, config: ExportConfig) -> StoredPolicy:
    return read_checkpoint(run.experiment, run.checkpoints, run.choose_checkpoint(config.checkpoint))


def _onnx(run: StoredRun, config: ExportConfig, path: Path) -> _Written:
    if path.is_dir():
        raise BadInput(f"--output {path}: is a folder; give a file, e.g. {path / 'policy.onnx'}")
    stored = _stored(run, config)
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
        _checkpoint(stored),
        *reads,
        f"policy       {what}",
        "command      steering in degrees, positive to the left; speed in m/s",
        f"checked      largest difference to the network {difference:.1e} on {checked:,} observations",
    ]


def _checkpoint(stored: StoredPolicy) -> str:
    return f"checkpoint   {stored.path.name}, iteration {stored.counters['iteration']}"


def _car(run: StoredRun, config: ExportConfig, path: Path) -> _Written:
    if not path.name.endswith(ENDING) or path.is_dir():
        raise BadInput(
            f"--output {path}: accepted: a file whose name ends in {ENDING}, as the car's console wants it"
        )
    stored = _stored(run, config)
    archive = car_archive(stored.networks, run.experiment)
    _write(path, archive.content)
    return [path], [
        _checkpoint(stored),
        f"model        {name_on_car(path.name)} on the car, {len(archive.content) / 1e6:.1f} MB",
        f"reads        {', '.join(archive.metadata.sensor)}",
        *archive.notes,
        "What the car makes of the actions, with its maximum speed at 100%:",
        *describe_commands(archive.metadata),
    ]


def _write(path: Path, content: bytes) -> None:
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, content)


def _aws_logs(run: StoredRun, config: ExportConfig, folder: Path) -> _Written:
    log = read_run_recording(run.path)
    notes = write_aws_logs(log, run.experiment, folder, config.layout)
    return [folder], [*notes, *map(str, log.recording.problems)]


def _aws_model(run: StoredRun, config: ExportConfig, folder: Path) -> _Written:
    stored = _stored(run, config)
    result = read_result(run.path)
    score = result.completion if result and result.iteration == stored.counters["iteration"] else None
    files, notes = aws_model(run.experiment, stored, _reward(run), score)
    write_files(files, folder)
    return (folder / name for name in sorted(files)), notes


def _reward(run: StoredRun) -> str:
    return read_text(run.path / REWARD, "the reward function that the run was trained with")


def _aws(run: StoredRun, _: ExportConfig, folder: Path) -> _Written:
    reward = _reward(run)
    texts, notes = aws_files(run.experiment, reward)
    write_files(texts, folder)
    refused = [
        f"reward_function.py: deepracer-on-aws would refuse it: {one}" for one in text_findings(reward)
    ]
    return (folder / name for name in texts), notes + refused


class DeployedPolicy(nn.Module):
    """The deterministic policy of an actor-critic, without value network and sampling.

    In: `observation` (N, features); or `pixels` (N, channels, height, width), bytes, and/or `lidar` (N, readings).
    Out: `policy`, the probabilities of the actions (N, n), or for a continuous policy the mean of [steering, speed]
    clipped to -1..1 (N, 2); and `command` (N, 2), degrees (positive to the left) and metres per second, of the
    likeliest action or of that mean.
    """

    def __init__(self, networks: ActorCritic, actions: ActionSpace):
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
        policy = outputs[0].clamp(-1.0, 1.0)
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
            f"format=onnx: needs the package {error.name}; install the project with its extra: "
            "pip install 'deepracer-exp[export]'"
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
    _write(path, content)
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
