"""Trajectory optimisation: the commands that take a car farthest in a number of control periods.

The method is iLQR with box constraints on the commands (Tassa, Mansard and Todorov, "Control-Limited Differential
Dynamic Programming", ICRA 2014). An augmented Lagrangian keeps a wheel on the road (Howell, Jackson and Manchester,
"ALTRO", IROS 2019).
"""

import math
from typing import NamedTuple

import numpy as np

from deepracer_exp.jit import njit
from deepracer_exp.sim.rollout import advance, linearise
from deepracer_exp.tracks.segments import along, is_on_road, nearest_segment

_BLUR_M = 0.005
"""Wheels whose distances to the border differ by less both count, so that their maximum has derivatives."""
_POSE = 3
"""The first entries of a state, on which the road depends."""
_NUDGE = 1e-5
_DAMP_SPEED, _DAMP_STEERING, _DAMP_ALONG, _DAMP_ACROSS, _DAMP_YAW = 0.01, 0.1, 0.05, 1.0, 0.1


class Motion(NamedTuple):
    """A car and its time steps."""

    cars: np.ndarray
    """The record of one car, (1,)."""
    drives: np.ndarray
    clock: tuple[int, float]
    """Physics steps of a control period, and seconds of one."""


class Aim(NamedTuple):
    """Limits and costs besides distance."""

    limits: np.ndarray
    """Lowest and highest speed and steering, (2, 2)."""
    multipliers: np.ndarray
    """Multiplier of the road's border at each state, (n + 1,)."""
    stiffness: float
    """Stiffness of the border: the growth of the cost of a wheel beside the road."""
    calm: np.ndarray
    """Cost of a change of speed and of steering, (2,)."""


@njit(cache=True)
def origin(state, com_x_m):  # type: ignore[no-untyped-def]
    """Return x and y of the chassis origin, and cosine and sine of the heading."""
    cos, sin = math.cos(state[2]), math.sin(state[2])
    return state[0] - com_x_m * (cos - 1.0), state[1] - com_x_m * sin, cos, sin


@njit(cache=True)
def _inside_m(course, x_m, y_m):  # type: ignore[no-untyped-def]
    """Return a point's distance from the nearest border, negative off the road."""
    nearest = np.inf
    for border in (course.inner, course.outer):
        row, fraction = nearest_segment(border, 0, x_m, y_m)
        x, y = along(border, row, fraction)
        nearest = min(nearest, math.hypot(x_m - x, y_m - y))
    return nearest if is_on_road(course.road, 0, x_m, y_m) else -nearest


@njit(cache=True)
def clearance_m(course, wheels_m, com_x_m, state):  # type: ignore[no-untyped-def]
    """Return the distance of the innermost wheel from the nearest border, negative if no wheel is on the road."""
    x, y, cos, sin = origin(state, com_x_m)
    inside = np.empty(len(wheels_m))
    for wheel in range(len(wheels_m)):
        ahead, left = wheels_m[wheel, 0], wheels_m[wheel, 1]
        inside[wheel] = _inside_m(course, x + cos * ahead - sin * left, y + sin * ahead + cos * left)
    most = inside.max()
    weight = np.exp((inside - most) / _BLUR_M)
    return (weight * inside).sum() / weight.sum()


@njit(cache=True)
def distance_m(course, front_point_m, com_x_m, closed, state):  # type: ignore[no-untyped-def]
    """Return the place on the centre line that the front of the car has reached.

    Beyond the end of an open course distances continue straight ahead.
    """
    x, y, cos, sin = origin(state, com_x_m)
    line, x, y = course.center, x + front_point_m * cos, y + front_point_m * sin
    row, fraction = nearest_segment(line, 0, x, y)
    begin, end = line.vertices[row], line.vertices[row + 1]
    place = begin.start_m + fraction * begin.length_m
    if not closed and row == line.lines[0].segments - 1 and fraction >= 1.0:
        heading = begin.heading_rad
        place += (x - end.x) * math.cos(heading) + (y - end.y) * math.sin(heading)
    return place


@njit(cache=True)
def driven_m(course, front_point_m, com_x_m, states, begin_m, closed):  # type: ignore[no-untyped-def]
    """Return the progress of the car's front along the centre line after each state, from `begin_m` on, (n,)."""
    length_m = course.center.lines[0].total_m
    driven = np.empty(len(states))
    before = 0.0
    for n in range(len(states)):
        now = distance_m(course, front_point_m, com_x_m, closed, states[n]) - begin_m
        if closed:
            now += length_m * math.floor((before - now) / length_m + 0.5)
        driven[n] = before = now
    return driven


@njit(cache=True)
def _penalty(short_m, multiplier, stiffness):  # type: ignore[no-untyped-def]
    """Return the augmented Lagrangian of a clearance `short_m` too small, and its derivatives by `short_m`."""
    pull = multiplier + stiffness * short_m
    if pull <= 0.0:
        return -0.5 * multiplier * multiplier / stiffness, 0.0, 0.0
    return 0.5 * (pull * pull - multiplier * multiplier) / stiffness, pull, stiffness


@njit(cache=True)
def _cost(problem, states, commands, aim):  # type: ignore[no-untyped-def]
    course, front_point_m, com_x_m, wheels_m, begin_m, closed, margin_m = problem
    total = -driven_m(course, front_point_m, com_x_m, states, begin_m, closed)[-1]
    # An open course ends with its road.
    for n in range(1, len(states) - (not closed)):
        short_m = margin_m - clearance_m(course, wheels_m, com_x_m, states[n])
        total += _penalty(short_m, aim.multipliers[n], aim.stiffness)[0]
    for n in range(len(commands)):
        for k in range(2):
            total += 0.5 * aim.calm[k] * (commands[n, k] - states[n, 8 - k]) ** 2
    return total


@njit(cache=True)
def _limited(hessian, gradient, low, high, change, free):  # type: ignore[no-untyped-def]
    """Minimise 0.5 d'Hd + g'd for d (2,) between bounds; write it into `change`, and which entries are free."""
    best = np.inf
    d = np.empty(2)
    for first in range(3):
        for second in range(3):
            held = (first, second)
            ok = True
            for k in range(2):
                if held[k] == 1:
                    d[k] = low[k]
                elif held[k] == 2:
                    d[k] = high[k]
            if first == 0 and second == 0:
                det = hessian[0, 0] * hessian[1, 1] - hessian[0, 1] * hessian[1, 0]
                d[0] = -(hessian[1, 1] * gradient[0] - hessian[0, 1] * gradient[1]) / det
                d[1] = -(hessian[0, 0] * gradient[1] - hessian[1, 0] * gradient[0]) / det
            elif first == 0:
                d[0] = -(gradient[0] + hessian[0, 1] * d[1]) / hessian[0, 0]
            elif second == 0:
                d[1] = -(gradient[1] + hessian[1, 0] * d[0]) / hessian[1, 1]
            for k in range(2):
                if held[k] == 0 and not low[k] <= d[k] <= high[k]:
                    ok = False
            if not ok:
                continue
            value = (
                0.5
                * (
                    hessian[0, 0] * d[0] * d[0]
                    + 2.0 * hessian[0, 1] * d[0] * d[1]
                    + hessian[1, 1] * d[1] * d[1]
                )
                + gradient[0] * d[0]
                + gradient[1] * d[1]
            )
            if value < best:
                best = value
                change[0], change[1] = d[0], d[1]
                free[0], free[1] = first == 0, second == 0


@njit(cache=True)
def _backward(problem, driven, aim, damping, derivatives, changes):  # type: ignore[no-untyped-def]
    """Write the change of each command, (n, 2), and its reaction to a change of the state, (n, 2, 15)."""
    course, front_point_m, com_x_m, wheels_m, _, closed, margin_m = problem
    states, commands = driven
    limits, multipliers, stiffness, calm = aim
    by_state, by_command = derivatives
    step, gain = changes
    size = states.shape[1]
    periods = len(commands)
    slope, bend = np.zeros(size), np.zeros((size, size))
    change, free = np.zeros(2), np.zeros(2, np.bool_)
    length_m = course.center.lines[0].total_m
    nudged = states[periods].copy()
    for k in range(_POSE):
        kept = nudged[k]
        nudged[k] = kept + 1e-4
        high = distance_m(course, front_point_m, com_x_m, closed, nudged)
        nudged[k] = kept - 1e-4
        low = distance_m(course, front_point_m, com_x_m, closed, nudged)
        nudged[k] = kept
        moved = high - low
        if closed:
            moved -= length_m * math.floor(moved / length_m + 0.5)
        slope[k] = -moved / 2e-4
    for n in range(periods, -1, -1):
        if n < periods:
            A, B = by_state[n], by_command[n]
            q_x = A.T @ slope
            q_u = B.T @ slope
            q_xx = A.T @ bend @ A
            q_ux = B.T @ bend @ A
            q_uu = B.T @ bend @ B
            for k in range(2):
                difference = commands[n, k] - states[n, 8 - k]
                q_u[k] += calm[k] * difference
                q_uu[k, k] += calm[k]
                q_x[8 - k] -= calm[k] * difference
                q_xx[8 - k, 8 - k] += calm[k]
                q_ux[k, 8 - k] -= calm[k]
            q_uu[0, 0] += damping * _DAMP_SPEED
            q_uu[1, 1] += damping * _DAMP_STEERING
            _limited(q_uu, q_u, limits[0] - commands[n], limits[1] - commands[n], change, free)
            K = np.zeros((2, size))
            if free[0] and free[1]:
                # Into its place: `solve` returns columns first, and numba warns of products of either order.
                K[:] = -np.linalg.solve(q_uu, q_ux)
            elif free[0]:
                K[0] = -q_ux[0] / q_uu[0, 0]
            elif free[1]:
                K[1] = -q_ux[1] / q_uu[1, 1]
            step[n] = change
            gain[n] = K
            slope = q_x + K.T @ (q_uu @ change) + K.T @ q_u + q_ux.T @ change
            bend = q_xx + K.T @ q_uu @ K + K.T @ q_ux + q_ux.T @ K
            bend = 0.5 * (bend + bend.T)
        if 0 < n < periods + closed:
            # States, too, are to stay near those that the derivatives were taken at, across the heading above all.
            cos, sin = math.cos(states[n, 2]), math.sin(states[n, 2])
            bend[0, 0] += damping * (_DAMP_ALONG * cos * cos + _DAMP_ACROSS * sin * sin)
            bend[1, 1] += damping * (_DAMP_ALONG * sin * sin + _DAMP_ACROSS * cos * cos)
            both = damping * (_DAMP_ALONG - _DAMP_ACROSS) * cos * sin
            bend[0, 1] += both
            bend[1, 0] += both
            bend[2, 2] += damping * _DAMP_YAW
            nudged = states[n].copy()
            short_m = margin_m - clearance_m(course, wheels_m, com_x_m, nudged)
            _, pull, curve = _penalty(short_m, multipliers[n], stiffness)
            if pull > 0.0:
                normal = np.zeros(_POSE)
                for k in range(_POSE):
                    kept = nudged[k]
                    nudged[k] = kept + _NUDGE
                    high = clearance_m(course, wheels_m, com_x_m, nudged)
                    nudged[k] = kept - _NUDGE
                    low = clearance_m(course, wheels_m, com_x_m, nudged)
                    nudged[k] = kept
                    normal[k] = -(high - low) / (2.0 * _NUDGE)
                for k in range(_POSE):
                    slope[k] += pull * normal[k]
                    for j in range(_POSE):
                        bend[k, j] += curve * normal[k] * normal[j]


@njit(cache=True)
def improve(motion, problem, driven, aim, damping, rounds):  # type: ignore[no-untyped-def]
    """Improve the `driven` states, (n + 1, 15), and commands, (n, 2), in place; return the damping to resume with."""
    cars, drives, clock = motion
    states, commands = driven
    limits = aim.limits
    periods, size = len(commands), states.shape[1]
    by_state, by_command = np.empty((periods, size, size)), np.empty((periods, size, 2))
    step, gain = np.empty((periods, 2)), np.empty((periods, 2, size))
    new_states, new_commands = states.copy(), commands.copy()
    cost = _cost(problem, states, commands, aim)
    stale = True
    for _ in range(rounds):
        if stale:
            linearise(cars, drives, states[:-1], commands, clock, (by_state, by_command))
            stale = False
        _backward(problem, driven, aim, damping, (by_state, by_command), (step, gain))
        share, improved = 1.0, False
        for _ in range(4):
            for n in range(periods):
                for k in range(2):
                    value = commands[n, k] + share * step[n, k]
                    for j in range(size):
                        value += gain[n, k, j] * (new_states[n, j] - states[n, j])
                    new_commands[n, k] = min(max(value, limits[0, k]), limits[1, k])
                advance(cars, drives, new_states[n], new_commands[n], clock, new_states[n + 1])
            new_cost = _cost(problem, new_states, new_commands, aim)
            if new_cost < cost - 1e-7:
                improved = True
                break
            share *= 0.4
        if improved:
            states[:] = new_states
            commands[:] = new_commands
            cost = new_cost
            stale = True
            damping = max(damping * (0.5 if share == 1.0 else 1.0), 1e-6)
        else:
            damping *= 4.0
    return damping
