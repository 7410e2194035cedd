"""Everything a car needs to know about its race, built once and sent to every process."""

from dataclasses import dataclass, replace

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.driving import EpisodeConfig, ObservationConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.randomization import RandomizationConfig
from deepracer_exp.tracks.track import Track

from .action_space import ActionSpace, build_action_space
from .courses import Course, build_courses
from .reward_source import RewardSource, load_reward_source


@dataclass(frozen=True, kw_only=True)
class RaceSetup:
    """Courses, car, actions, features, rules and reward of one experiment; picklable."""

    courses: tuple[Course, ...]
    car: CarConfig
    actions: ActionSpace
    observation: ObservationConfig
    randomization: RandomizationConfig
    episode: EpisodeConfig
    reward: RewardSource
    reward_time_limit_s: float
    seed: int

    @property
    def track(self) -> Track:
        """Return the first course's track, as its first episode drives it."""
        return self.courses[0].tracks[0]

    def on(self, track: Track) -> "RaceSetup":
        """Return the same race on this track alone."""
        return replace(self, courses=(Course(name=track.name, weight=1.0, tracks=(track,)),))


def build_setup(experiment: Experiment) -> RaceSetup:
    """Read the files an experiment names and build what its environments need.

    Raises:
        BadInput: a route, model_metadata or reward file is missing or malformed, or values contradict.
    """
    return RaceSetup(
        courses=build_courses(experiment),
        car=experiment.car,
        actions=build_action_space(experiment.action_space),
        observation=experiment.observation,
        randomization=experiment.randomization,
        episode=experiment.episode,
        reward=load_reward_source(experiment.reward),
        reward_time_limit_s=experiment.reward.time_limit_s,
        seed=experiment.seed,
    )
