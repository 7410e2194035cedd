"""Batches of driving put together to what an update learns from."""

import time
from collections.abc import Iterator

import torch
from tensordict import TensorDictBase

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import AlgorithmConfig

from .batches import Batches
from .collection import worker_count

_CHUNK_STEPS = 32  # steps a car drives between two looks at how many episodes have ended


def iterations(
    collection: Batches, algorithm: AlgorithmConfig, separate: bool
) -> Iterator[tuple[TensorDictBase, float]]:
    """Yield what an update learns from, and the seconds it took to collect.

    Args:
        collection: the source of batches.
        algorithm: says how many frames or episodes an iteration has.
        separate: batches come from different cars and cannot be joined along time.
    """
    chunks: list[TensorDictBase] = []
    frames = episodes = 0
    began = time.monotonic()
    for chunk in collection:
        frames += chunk.numel()
        episodes += int(chunk["next", "done"].sum())
        wanted = algorithm.episodes_per_iteration
        enough = frames >= (algorithm.frames_per_iteration or 0) if wanted is None else episodes >= wanted
        if enough and not chunks:
            yield chunk, time.monotonic() - began
        elif enough:
            whole = torch.cat([*chunks, chunk], dim=0 if separate else 1)
            yield whole, time.monotonic() - began
        else:
            chunks.append(chunk.clone())
            continue
        chunks, frames, episodes = [], 0, 0
        began = time.monotonic()


def frames_per_batch(experiment: Experiment) -> int:
    """Return the control steps, over all cars, to ask of a collector at a time."""
    collector = experiment.collector
    workers = max(1, worker_count(collector))
    frames = experiment.algorithm.frames_per_iteration
    if frames is None:
        return workers * collector.cars * _CHUNK_STEPS
    return -(-frames // workers) if collector.mode == "async" else frames
