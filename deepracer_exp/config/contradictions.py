"""Values of an experiment that contradict one another."""

from deepracer_exp.errors import BadInput, nearest
from deepracer_exp.formats.worlds import worlds

from .experiment import Experiment
from .track import TrackConfig


def check_together(experiment: Experiment) -> None:
    """Refuse values that are each accepted but contradict one another.

    Raises:
        BadInput: the message names the keys, their values and what is accepted there.
    """
    algorithm, collector = experiment.algorithm, experiment.collector
    if (algorithm.frames_per_iteration is None) == (algorithm.episodes_per_iteration is None):
        raise BadInput(
            f"algorithm.frames_per_iteration={algorithm.frames_per_iteration} and "
            f"algorithm.episodes_per_iteration={algorithm.episodes_per_iteration}: set exactly one, the other null"
        )
    frames = algorithm.frames_per_iteration
    if frames is not None and algorithm.batch_size > frames:
        raise BadInput(
            f"algorithm.batch_size={algorithm.batch_size} is larger than "
            f"algorithm.frames_per_iteration={frames}: a minibatch cannot hold more steps than an iteration"
        )
    if frames is not None and frames < collector.cars:
        raise BadInput(
            f"algorithm.frames_per_iteration={frames} is smaller than collector.cars={collector.cars}: "
            "each car takes at least one step an iteration"
        )
    if collector.mode == "in_process" and collector.processes not in (None, 1):
        raise BadInput(
            f"collector.processes={collector.processes} with collector.mode=in_process: "
            "choose collector=sync or collector=async for several processes"
        )
    if collector.mode == "ray" and collector.processes is None:
        raise BadInput(
            "collector.processes=null with collector=ray: a cluster grows and shrinks; give the number of processes"
        )
    limit_s, hang_s = experiment.reward.time_limit_s, collector.hang_timeout_s
    if collector.mode != "in_process" and limit_s >= hang_s:
        raise BadInput(
            f"reward.time_limit_s={limit_s:g} is not below collector.hang_timeout_s={hang_s:g}: a worker waiting for "
            "its reward function would be taken for one that hangs"
        )
    delay, still = experiment.randomization.action_delay_steps[1], experiment.episode.immobilized_steps
    if still and delay + 1 >= still:
        raise BadInput(
            f"randomization.action_delay_steps reaches {delay} with episode.immobilized_steps={still}: a car whose "
            f"commands come so late counts as standing before it moves; accepted there: up to {max(0, still - 2)}"
        )
    for name, track in experiment.tracks.items():
        key = f"track.{name}" if isinstance(experiment.track, dict) else "track"
        _check_shape(key, track)
    cars = collector.cars * (collector.processes or 1)
    if cars < len(experiment.tracks):
        raise BadInput(
            f"collector.cars={collector.cars} with {len(experiment.tracks)} tracks: every track needs a car; accepted "
            f"there: at least {-(-len(experiment.tracks) // (collector.processes or 1))}"
        )


def _check_shape(key: str, track: TrackConfig) -> None:
    knots, width_m = track.knots, track.width_m
    if (knots is None) != (width_m is None):
        there, missing = ("width_m", "knots") if knots is None else ("knots", "width_m")
        raise BadInput(
            f"{key}.{there} without {key}.{missing}: a road of one's own has both, a world neither"
        )
    if knots is not None and isinstance(width_m, tuple) and len(width_m) != len(knots):
        raise BadInput(
            f"{key}.width_m has {len(width_m)} values and {key}.knots {len(knots)}: give one width, or one per knot"
        )
    if knots is None and track.file is None and track.name not in worlds():
        raise BadInput(
            f"{key}.name={track.name}: no world of the service{nearest(track.name, worlds())}; a track of one's own "
            "has knots and width_m, or a file"
        )
