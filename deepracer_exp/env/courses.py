"""The courses of an experiment, and which cars drive on them."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.track import TrackConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.tracks.track import Track


@dataclass(frozen=True, kw_only=True)
class Course:
    """A track in the directions it is driven."""

    name: str
    weight: float
    """How many of the cars drive here, relative to the other courses."""
    tracks: tuple[Track, ...]
    """One a direction; where there are two, they are driven in turn, episode by episode."""


def build_courses(experiment: Experiment) -> tuple[Course, ...]:
    """Build the tracks of an experiment in the directions they are driven.

    Raises:
        BadInput: a route is missing or malformed, or an open course is to be started elsewhere than at its start.
    """
    courses = tuple(_build(name, config) for name, config in experiment.tracks.items())
    for course in courses:
        if experiment.episode.start_offset and not course.tracks[0].closed:
            raise BadInput(
                f"episode.start_offset={experiment.episode.start_offset:g}: the open course {course.name} can only "
                "be completed from its start; accepted there: 0"
            )
    return courses


def _build(name: str, config: TrackConfig) -> Course:
    directions = {"forward": (False,), "reversed": (True,), "alternate": (False, True)}[config.direction]
    tracks = tuple(Track.from_config(config, backwards) for backwards in directions)
    return Course(name=name, weight=config.weight, tracks=tracks)


def deal(weights: Sequence[float]) -> Iterator[int]:
    """Yield the place of the course of car 0, 1, 2, ... without end.

    The first cars take a course each; after that a car goes where most is missing of the share that the weights
    promise. So any long enough row of neighbouring cars holds all courses by their weights, and a car's course does
    not depend on how many there are beside it.
    """
    total = sum(weights)
    count = [0] * len(weights)
    for car in itertools.count():
        missing = [weight / total * (car + 1) - has for weight, has in zip(weights, count, strict=True)]
        place = car if car < len(weights) else missing.index(max(missing))
        count[place] += 1
        yield place


def courses_of_cars(weights: Sequence[float], cars: int) -> NDArray[np.intp]:
    """Return what `deal` gives the first `cars` cars, shape (cars,)."""
    return np.fromiter(itertools.islice(deal(weights), cars), np.intp, cars)
