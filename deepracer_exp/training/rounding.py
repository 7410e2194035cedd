"""Notes on steps, cars and minibatches that do not divide evenly."""

from deepracer_exp.collectors.collector import steps_per_batch
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import PPOConfig


def rounded(experiment: Experiment) -> list[str]:
    """Return a line for each value of the algorithm that is rounded: key, value, actual.

    Nothing is known in advance of iterations that are counted in episodes.
    """
    algorithm, cars = experiment.algorithm, experiment.collector.cars
    wanted = algorithm.frames_per_iteration
    if wanted is None:
        return []
    lines, each = [], steps_per_batch(experiment.collector, wanted)
    frames = each * cars
    if frames != wanted:
        lines.append(
            f"algorithm.frames_per_iteration={wanted}: each iteration has {frames:,} steps, {each:,} of each of "
            f"{cars:,} cars"
        )
    # Soft actor-critic draws its minibatches from a replay, and a class of the user's own may do anything.
    if not isinstance(algorithm, PPOConfig) or algorithm.target is not None:
        return lines
    size = algorithm.batch_size
    if left_out := frames % size:
        lines.append(
            f"algorithm.batch_size={size}: each pass leaves out {left_out:,} of an iteration's {frames:,} steps, "
            "others each time"
        )
    return lines
