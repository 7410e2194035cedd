"""The command `export`: write a policy as ONNX, or a run's files or logs in the layouts of AWS."""

from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.evaluation import ExportConfig
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.observation import feature_names
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.checkpoints import read_checkpoint
from deepracer_exp.runs.files import EXPORTS, REWARD
from deepracer_exp.runs.own_recording import read_own_recording
from deepracer_exp.runs.resolve import StoredRun, resolve
from deepracer_exp.validation.console import console_findings

from .aws_files import aws_files, write_texts
from .aws_logs import write_aws_logs
from .onnx_file import CHECKED, CHECKED_PICTURES, DeployedPolicy, write_onnx


def export(config: ExportConfig, output: str | None, out: Console) -> Path:
    """Export a run in the chosen format and print what was written.

    Raises:
        BadInput: the run, the checkpoint or the output cannot be used, or a package is missing.
        RunFailed: the ONNX file differs from the network.
    """
    run = resolve(config.run, Path(config.runs_dir), config.tracking.uri)
    exports = run.path / EXPORTS
    if config.format == "onnx":
        checkpoint = run.choose_checkpoint(config.checkpoint)
        return _onnx(run, checkpoint, Path(output or exports / "policy.onnx"), out)
    if config.format == "aws-logs":
        return _aws_logs(run, Path(output or exports / "aws-logs"), config.layout, out)
    return _aws(run, Path(output or exports / "aws"), out)


def _onnx(run: StoredRun, checkpoint: str, path: Path, out: Console) -> Path:
    if path.is_dir():
        raise BadInput(f"--output {path}: is a folder; give a file, e.g. {path / 'policy.onnx'}")
    stored = read_checkpoint(run.experiment, run.checkpoints, checkpoint)
    actions = build_action_space(run.experiment.action_space)
    torch.set_num_threads(1)
    facts: dict[str, Any] = {
        "run": run.path.name,
        "checkpoint": stored.path.name,
        "control_period_s": run.experiment.car.control_period_s,
    }
    observation = run.experiment.observation
    features = feature_names(observation)
    if observation.camera is None:
        facts["features"] = features
        reads = f"observation  {len(features)} features, named in the file's metadata"
    else:
        facts["camera"] = vars(observation.camera)
        channels, height, width = observation.camera.shape
        reads = f"pixels       pictures of {width}x{height} in bytes, channels: {channels}"
    observed = ObservationShape(len(features), observation.picture)
    difference = write_onnx(DeployedPolicy(stored.networks, actions), observed, facts, path)
    out.print(f"{path}", soft_wrap=True)
    out.print(f"  checkpoint   {stored.path.name}, iteration {stored.counters['iteration']}")
    out.print(f"  {reads}")
    what = f"probabilities of {actions.n} actions" if actions.n else "mean steering and speed, -1 to 1"
    out.print(f"  policy       {what}")
    out.print("  command      steering in degrees, positive to the left; speed in m/s")
    checked = CHECKED if observation.camera is None else CHECKED_PICTURES
    out.print(
        f"  checked      largest difference to the network {difference:.1e} on {checked:,} observations"
    )
    return path


def _aws_logs(run: StoredRun, folder: Path, layout: str, out: Console) -> Path:
    recording = read_own_recording(run.path)
    notes = write_aws_logs(recording, run.experiment, folder, layout)
    out.print(f"{folder}", soft_wrap=True)
    for note in (*notes, *map(str, recording.problems)):
        out.print(f"  {note}", soft_wrap=True)
    return folder


def _aws(run: StoredRun, folder: Path, out: Console) -> Path:
    source = run.path / REWARD
    try:
        reward = source.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(
            f"{source}: cannot be read: {error}; this is the reward the run was trained with"
        ) from error
    texts, notes = aws_files(run.experiment, build_action_space(run.experiment.action_space), reward)
    write_texts(texts, folder)
    for name in texts:
        out.print(f"{folder / name}", soft_wrap=True)
    for note in notes:
        out.print(f"  {note}", soft_wrap=True)
    for finding in console_findings(reward):
        out.print(f"  reward_function.py: the AWS console would reject it: {finding}", soft_wrap=True)
    return folder
