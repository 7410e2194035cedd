"""The service's worlds as courses, and how to recognise the world of a recording."""

from functools import cache
from typing import NamedTuple

import numpy as np

from deepracer_exp.deepracer.routes import world_rows
from deepracer_exp.deepracer.worlds import find_world, worlds

from .track import PLAIN_FLOOR, Track

NEAR_M = 1.0
"""Largest mean distance of a recording's poses from their closest waypoints: roads are up to 2 m wide."""


class Recognised(NamedTuple):
    """A world that matches a recording."""

    name: str
    reversed: bool
    distance_m: float
    """Mean distance between the recorded points and the waypoints recorded as closest."""


@cache
def world_track(name: str, reversed: bool = False) -> Track:
    """Return a world's course on a plain floor.

    Args:
        name: its name in the service in any case of letters, or its official name.
        reversed: Drive against the order of its waypoints.

    Raises:
        BadInput: there is no such world.
    """
    found = find_world(name) or name
    rows = world_rows(found)
    return Track.from_route(rows, found, title=worlds()[found].title, reversed=reversed, floor=PLAIN_FLOOR)


def recognise(points: np.ndarray, closest_waypoint: np.ndarray) -> list[Recognised]:
    """Return the worlds that match a recording, the best first; equal ones in the catalogue's order.

    Every world has its own numbering of waypoints: in the right one, each recorded waypoint is near the point where it
    was recorded.

    Args:
        points: recorded points (n, 2) in metres; a few hundred from all around the lap are enough.
        closest_waypoint: the waypoint recorded with each (n,).
    """
    found = []
    last = int(closest_waypoint.max())
    for world in worlds().values():
        if last < world.rows:
            waypoints = world_rows(world.name)[:, :2]
            for reversed, line in ((False, waypoints), (True, waypoints[::-1])):
                away_m = np.linalg.norm(points - line[closest_waypoint], axis=1)
                found.append(Recognised(world.name, reversed, float(away_m.mean())))
    near = [one for one in found if one.distance_m < NEAR_M]
    return sorted(near, key=lambda one: round(one.distance_m, 6))
