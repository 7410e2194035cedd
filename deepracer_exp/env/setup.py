"""Everything a race needs, built once from an experiment and sent to every process: courses, car, actions, reward."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.driving import (
    EpisodeConfig,
    ObservationConfig,
    RandomizationConfig,
    car_differs,
)
from deepracer_exp.config.evaluation import RealCarConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.racing import RaceConfig
from deepracer_exp.env.others.boxes_and_bots import check_room
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.source import RewardSource, load_reward_source
from deepracer_exp.tracks.track import Track, directed_tracks

from .action_space import ActionSpace, build_action_space
from .observation import ObservationPart, build_parts
from .race_files import RaceFiles


@dataclass(frozen=True, kw_only=True)
class Course:
    """A track with its directions of driving."""

    name: str
    weight: float
    """Weight of the course in the distribution of cars."""
    tracks: tuple[Track, ...]
    """One per direction; two directions alternate from episode to episode."""


def build_courses(
    experiment: Experiment, built: Mapping[str, tuple[Track, ...]] = MappingProxyType({})
) -> tuple[Course, ...]:
    """Build the courses of an experiment; those tracks that are `built` already are taken as they are.

    Raises:
        BadInput: a route is missing or malformed, or an open course is not started at its start.
    """
    courses = tuple(
        Course(name=name, weight=config.weight, tracks=built.get(name) or directed_tracks(config))
        for name, config in experiment.tracks.items()
    )
    for course in courses:
        if experiment.episode.start_offset and not course.tracks[0].closed:
            raise BadInput(
                f"episode.start_offset={experiment.episode.start_offset:g}: the open course {course.name} can only "
                "be completed from its start; accepted: 0"
            )
    return courses


def deal(weights: Sequence[float]) -> Iterator[int]:
    """Yield the index of the course of car 0, 1, 2, ... without end.

    Each of the first cars takes another course; every further car takes the course that is furthest below its share by
    weight. So any long enough range of cars covers the courses in proportion to their weights, and a car's course does
    not depend on the number of cars.
    """
    total = sum(weights)
    count = [0] * len(weights)
    for car in itertools.count():
        missing = [weight / total * (car + 1) - has for weight, has in zip(weights, count, strict=True)]
        place = car if car < len(weights) else missing.index(max(missing))
        count[place] += 1
        yield place


def courses_of_cars(weights: Sequence[float], cars: int) -> NDArray[np.intp]:
    """Return the course of each of the first `cars` cars as in `deal`, shape (cars,)."""
    return np.fromiter(itertools.islice(deal(weights), cars), np.intp, cars)


def places_of_cars(weights: Sequence[float], cars: int) -> NDArray[np.intp]:
    """Return the number of each of the first `cars` cars among those on its course, from 0, shape (cars,)."""
    course = courses_of_cars(weights, cars)
    order = np.argsort(course, kind="stable")
    places = np.empty(cars, np.intp)
    places[order] = np.arange(cars) - np.searchsorted(course[order], course[order])
    return places


def usual_cars(weights: Sequence[float], car_share: float, cars: int) -> NDArray[np.bool_]:
    """Return which of the first `cars` cars drive on usual conditions, whose lap times compare, shape (cars,).

    They are those that `randomization.car_share` leaves as they are; on a course where it leaves none, all.
    """
    course = courses_of_cars(weights, cars)
    differs = np.array([car_differs(place, car_share) for place in places_of_cars(weights, cars).tolist()])
    alone = np.bincount(course, ~differs, len(weights)) == 0
    return ~differs | alone[course]


@dataclass(frozen=True, kw_only=True)
class RaceSetup:
    """Courses, car, actions, features, rules and reward of one experiment; picklable."""

    courses: tuple[Course, ...]
    car: CarConfig
    actions: ActionSpace
    observation: ObservationConfig
    observation_parts: tuple[ObservationPart, ...]
    """Built here and sent to the workers as objects: they may not import classes that a configuration names."""
    randomization: RandomizationConfig
    episode: EpisodeConfig
    reward: RewardSource
    reward_time_limit_s: float
    seed: int
    others: RaceConfig | None = None
    """Boxes and bots around every car; None: it is alone."""
    real_car: RealCarConfig | None = None
    late_steps: tuple[int, int] = (0, 0)
    """Control steps that steering and speed commands take beyond the drawn delay, for every car."""

    @property
    def weights(self) -> list[float]:
        """Return the weight of each course in the distribution of cars."""
        return [course.weight for course in self.courses]

    @property
    def track(self) -> Track:
        """Return the first course's track in the direction of its first episode."""
        return self.courses[0].tracks[0]

    def on(self, track: Track) -> "RaceSetup":
        """Return the same race on this track only."""
        return replace(self, courses=(Course(name=track.name, weight=1.0, tracks=(track,)),))


def build_setup(
    experiment: Experiment,
    courses: tuple[Course, ...] | None = None,
    reward: RewardSource | None = None,
    files: RaceFiles | None = None,
    race: RaceConfig | None = None,
) -> RaceSetup:
    """Build the race of an experiment; `courses`, `reward` and `race` replace its own, files not read yet are read.

    Raises:
        BadInput: a route, model_metadata or reward file is missing or malformed, values contradict, or a track has no
            room for the others.
    """
    courses = courses or build_courses(experiment, {} if files is None else files.tracks)
    race = race or experiment.race
    check_room(race, [(course.name, course.tracks[0]) for course in courses])
    return RaceSetup(
        courses=courses,
        car=experiment.car,
        actions=build_action_space(experiment.action_space) if files is None else files.actions,
        observation=experiment.observation,
        observation_parts=build_parts(experiment.observation),
        randomization=experiment.randomization,
        episode=experiment.episode,
        reward=reward or (load_reward_source(experiment.reward) if files is None else files.reward),
        reward_time_limit_s=experiment.reward.time_limit_s,
        seed=experiment.seed,
        others=race if race.others else None,
    )
