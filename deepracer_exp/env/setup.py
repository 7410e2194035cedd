"""Everything a car needs to know about its race, built once and sent to every process."""

from dataclasses import dataclass

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.driving import EpisodeConfig, ObservationConfig, RandomizationConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.tracks.track import Track

from .action_space import ActionSpace, build_action_space
from .reward_source import RewardSource, load_reward_source


@dataclass(frozen=True, kw_only=True)
class RaceSetup:
    """Track, car, actions, features, rules and reward of one experiment; picklable."""

    track: Track
    car: CarConfig
    actions: ActionSpace
    observation: ObservationConfig
    randomization: RandomizationConfig
    episode: EpisodeConfig
    reward: RewardSource
    reward_time_limit_s: float
    seed: int


def build_setup(experiment: Experiment) -> RaceSetup:
    """Read the files an experiment names and build what its environments need.

    Raises:
        BadInput: a route, model_metadata or reward file is missing or malformed, or values contradict.
    """
    track = Track.from_config(experiment.track)
    if experiment.episode.start_offset and not track.closed:
        raise BadInput(
            f"episode.start_offset={experiment.episode.start_offset:g}: the open course {track.name} can only be "
            "completed from its start; accepted there: 0"
        )
    return RaceSetup(
        track=track,
        car=experiment.car,
        actions=build_action_space(experiment.action_space),
        observation=experiment.observation,
        randomization=experiment.randomization,
        episode=experiment.episode,
        reward=load_reward_source(experiment.reward),
        reward_time_limit_s=experiment.reward.time_limit_s,
        seed=experiment.seed,
    )
