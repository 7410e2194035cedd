"""How fast a perfect driver could lap, beside the records of the service's leaderboards.

    python -m benchmarks.lap_bounds --anchors FILE.csv [--car NAME] [--json FILE]

FILE.csv has a row for each board: columns world, race_type, date and best_lap_s; time trials since March 2020 count,
when commands went up to 4 m/s. For each world a line between the borders (not all wheels may leave the road) is driven
quasi-steadily: everywhere at the speed at which the car holds the line's curvature in a steady turn, with speed
changed at once. The best of lines between the shortest and the straightest is bent further until it is fastest. A bound
above a record says that the simulated car cannot do what a car of the service did.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import lsq_linear, minimize
from scipy.sparse import block_diag, csr_array, diags_array, vstack

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.options import options_of
from deepracer_exp.sim.batch import CarBatch
from deepracer_exp.tracks.track import Track

from .report import benchmark_parser, number, table, with_exit_code, write_json

Floats = NDArray[np.float64]

_SINCE = "2020-03"
_POINTS = 300
_STRAIGHTNESS = (0.0, 1.0, 10.0, 100.0, 1000.0)
"""How much curvature counts beside length in the lines to begin with."""
_KNOTS = 75
"""Points of a line that are moved to make it faster."""
_SETTLED_S, _STEADY = 4.0, 0.02
_MOST_SLIDE = np.tan(np.deg2rad(30))


class Cornering(NamedTuple):
    """The fastest steady turns of a car, by falling curvature."""

    curvature_per_m: Floats
    speed_mps: Floats

    def speed_at(self, curvature: Floats) -> Floats:
        """Return the highest speed at which each curvature, in 1/m, is held."""
        return np.interp(-np.abs(curvature), -self.curvature_per_m, self.speed_mps)


def cornering(car: CarConfig) -> Cornering:
    """Drive a car in circles of many speeds and steering angles, and keep those that it holds without spinning."""
    commands = np.stack(
        np.meshgrid(np.linspace(0.3, car.max_speed_mps, 75), np.linspace(0, car.max_steering_deg, 61))
    )
    speed, steering = commands.reshape(2, -1)
    cars = CarBatch(car, len(speed), 0)
    rate, steady = np.zeros(len(speed)), np.zeros(len(speed), bool)
    for _ in range(int(_SETTLED_S * car.control_hz)):
        cars.drive(speed, np.deg2rad(steering))
        now = cars.read()
        steady = np.abs(now.yaw_rate_radps - rate) < _STEADY
        rate = now.yaw_rate_radps
    held = steady & (np.abs(now.lateral_mps) < _MOST_SLIDE * now.speed_mps)
    driven = np.hypot(now.speed_mps, now.lateral_mps)[held]
    curvature = np.abs(rate[held]) / driven
    # At a wider curve than a turn's, its speed can be held as well.
    order = np.argsort(-curvature)
    return Cornering(curvature[order], np.maximum.accumulate(driven[order]))


def bound_s(track: Track, car: CarConfig, turns: Cornering) -> float:
    """Return the time in which a perfect driver would lap."""
    inner, outer = _resampled(track.inner), _resampled(track.outer)
    half = 0.5 * (outer - inner)
    width = np.hypot(*half.T)
    # The car is off when all its wheels are.
    reach = 1.0 + max(car.front_wheel_y_m, car.rear_wheel_y_m) / width
    middle, count = 0.5 * (outer + inner), _POINTS
    ahead = diags_array([-np.ones(count), np.ones(count - 1), [1.0]], offsets=[0, 1, 1 - count]).tocsr()
    # On an even grid, differences are lengths and second differences curvature.
    spread = vstack([diags_array(half[:, 0]), diags_array(half[:, 1])]).tocsr()
    step, bend = _both(ahead), _both(ahead.T @ ahead)
    best, fastest = np.inf, np.zeros(count)
    for weight in _STRAIGHTNESS:
        matrix = vstack([step @ spread, weight * (bend @ spread)]).tocsr()
        target = -np.concatenate([step @ middle.T.ravel(), weight * (bend @ middle.T.ravel())])
        offset = lsq_linear(matrix, target, bounds=(-reach, reach), lsmr_tol="auto", max_iter=200).x
        time = _time_s(middle + offset[:, None] * half, turns)
        if time < best:
            best, fastest = time, offset
    to_knots = np.arange(_KNOTS + 1) * (count // _KNOTS)

    def bent(moved: Floats) -> Floats:
        change = CubicSpline(to_knots, np.append(moved, moved[0]), bc_type="periodic")(np.arange(count))
        return middle + np.clip(fastest + change, -reach, reach)[:, None] * half

    found = minimize(
        lambda moved: _time_s(bent(moved), turns),
        np.zeros(_KNOTS),
        method="L-BFGS-B",
        options={"eps": 1e-4, "maxiter": 60},
    )
    return min(best, float(found.fun))


def _both(matrix: csr_array) -> csr_array:
    """Return a matrix that does the same to x and y."""
    return block_diag([matrix, matrix]).tocsr()


def _resampled(line: Floats) -> Floats:
    """Return a closed line as `_POINTS` points at equal shares of its points."""
    at = np.linspace(0, len(line) - 1, _POINTS, endpoint=False)
    return np.stack([np.interp(at, np.arange(len(line)), line[:, axis]) for axis in (0, 1)], axis=1)


def _time_s(line: Floats, turns: Cornering) -> float:
    before, after = np.roll(line, 1, axis=0), np.roll(line, -1, axis=0)
    a, b, c = (np.hypot(*(p - q).T) for p, q in ((before, line), (line, after), (before, after)))
    (ux, uy), (wx, wy) = (line - before).T, (after - before).T
    twice_area = np.abs(ux * wy - uy * wx)
    # Menger curvature of three neighbouring points, smoothed over as many.
    curvature = 2.0 * twice_area / np.maximum(a * b * c, 1e-12)
    curvature = (np.roll(curvature, 1) + curvature + np.roll(curvature, -1)) / 3.0
    return float(np.sum(0.5 * (a + b) / turns.speed_at(curvature)))


def measure(car: CarConfig, boards: pd.DataFrame) -> list[dict[str, Any]]:
    """Return each world's record and bound."""
    turns, rows, known = cornering(car), [], options_of("track")
    for world, of_world in boards.groupby("world"):
        # Some worlds stand in the catalogue once for each direction only.
        option = next((name for name in (world, f"{world}_ccw") if name in known), None)
        if option is None:
            print(f"{world}: not in the catalogue", file=sys.stderr)
            continue
        track = Track.from_config(next(iter(compose_experiment([f"track={option}"])[0].tracks.values())))
        record, bound = float(of_world["best_lap_s"].min()), bound_s(track, car, turns)
        rows.append({"world": world, "record_s": record, "bound_s": round(bound, 3), "below": bound < record})
    return rows


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Compute, print and store."""
    parser = benchmark_parser("lap_bounds", __doc__, None)
    parser.add_argument("--anchors", type=Path, required=True, help="records of leaderboards as CSV")
    parser.add_argument("--car", default="deepracer", help="the simulated car (an option of conf/car)")
    options = parser.parse_args(arguments)
    boards = pd.read_csv(options.anchors)
    boards = boards[(boards["race_type"] == "TIME_TRIAL") & (boards["date"] >= _SINCE)]
    rows = measure(compose_experiment([f"car={options.car}"])[0].car, boards)
    print(
        table(
            ("world", "record (s)", "bound (s)", "share"),
            [
                (
                    r["world"],
                    number(r["record_s"], 2),
                    number(r["bound_s"], 2),
                    number(r["bound_s"] / r["record_s"], 2),
                )
                for r in rows
            ],
        )
    )
    below = sum(bool(row["below"]) for row in rows)
    print(f"\n{below} of {len(rows)} worlds: the bound is below the record")
    write_json(options.json, {"car": options.car, "worlds": rows, "below": below})


if __name__ == "__main__":
    sys.exit(main())
