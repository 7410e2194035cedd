"""The resources of a training: an estimate of its memory, and the machine's load while it runs."""

import math

import psutil
import torch

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import SACConfig
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.errors import BadInput

_COPIES_OF_PICTURES = 8
"""Copies of a step's picture at the peak of an iteration: before and after it, in workers, batch and shuffled steps.
Measured: 7.1 with collector=in_process, 7.8 with sync."""
_OTHER_BYTES = 14
"""Bytes of a step in a replay beside the observations: a continuous action, reward and done flags."""


def memory_needed(experiment: Experiment) -> list[str]:
    """Return a line for each large use of memory.

    Raises:
        BadInput: it takes more than is free.
    """
    return [line for line in (_pictures(experiment), _replay(experiment)) if line is not None]


def _pictures(experiment: Experiment) -> str | None:
    """Return a line that says how much memory the pictures of an iteration take; None: there are none."""
    camera, algorithm = experiment.observation.camera, experiment.algorithm
    if camera is None:
        return None
    bytes_per_step, free = _COPIES_OF_PICTURES * math.prod(camera.shape), psutil.virtual_memory().available
    steps = algorithm.frames_per_iteration or 1000  # the length of episodes is not known
    needed = steps * bytes_per_step
    if algorithm.frames_per_iteration is not None and needed > free:
        raise BadInput(
            f"algorithm.frames_per_iteration={steps}: the pictures of so many steps take {needed / 1e9:.1f} GB of "
            f"memory, and {free / 1e9:.1f} GB are free; accepted: up to {free // bytes_per_step}, or smaller or fewer "
            "pictures (observation.camera)"
        )
    each = "the" if algorithm.frames_per_iteration is not None else "each"
    return (
        f"pictures: {needed / 1e9:.1f} GB of memory for {each} {steps:,} steps of an iteration, "
        f"{free / 1e9:.1f} GB are free"
    )


def _replay(experiment: Experiment) -> str | None:
    """Return a line on a replay that memory limits, or that holds pictures; None: there is no such replay."""
    algorithm = experiment.algorithm
    if not isinstance(algorithm, SACConfig):
        return None
    observed = observation_shape(experiment.observation)
    picture = math.prod(observed.picture or (0,))
    # The observations before and after the step.
    bytes_per_step = 2 * (4 * (observed.features + (observed.lidar or 0)) + picture) + _OTHER_BYTES
    steps = min(algorithm.replay_steps, algorithm.replay_mb * 10**6 // bytes_per_step)
    if steps < algorithm.batch_size:
        raise BadInput(
            f"algorithm.replay_steps={algorithm.replay_steps}, algorithm.replay_mb={algorithm.replay_mb}",
            f"the replay holds {steps:,} steps",
            f"at least a minibatch of {algorithm.batch_size:,}",
        )
    needed, free = steps * bytes_per_step, psutil.virtual_memory().available
    if needed > free:
        raise BadInput(
            f"algorithm.replay_mb={algorithm.replay_mb}",
            f"the replay takes {needed / 1e9:.1f} GB of memory, and {free / 1e9:.1f} GB are free",
            f"up to {free // 10**6}",
        )
    if steps == algorithm.replay_steps and not picture:
        return None
    return f"replay: the newest {steps:,} steps, {needed / 1e9:.1f} GB of memory and in the run folder"


def machine_use(device: str) -> dict[str, float]:
    """Return the use of cores and memory of this machine, in the columns of MLflow's page of system metrics.

    `cpu_percent` is a mean since the last call and of all cores; `memory_mb` and `gpu_memory_mb` are millions of bytes.
    The GPU's is that of `device`, if it is one.
    """
    memory = psutil.virtual_memory()
    use = {
        "cpu_percent": psutil.cpu_percent(),
        "memory_mb": memory.used / 1e6,
        "memory_percent": memory.percent,
    }
    if device != "cpu":
        free, total = torch.cuda.mem_get_info(torch.device(device))
        use["gpu_memory_mb"] = (total - free) / 1e6
    return use
