"""How fast a perfect driver could lap, beside the records of the official boards.

    python -m benchmarks.lap_bounds [--json FILE]

For each world with boards of time trials since March 2020 (`deepracer_exp/tracks/boards.csv`) and each car of their
time (that of version 4 stands in for version 3), the fastest official lap stands beside the least time of a flying lap
(`tracks.line_time`), with all that the simulated car can do within its own limits. A bound above a record says that the
simulated car cannot do what a car of the service did.
"""

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.options import options_of
from deepracer_exp.sim.ability import Ability, ability_of
from deepracer_exp.tracks.boards import boards
from deepracer_exp.tracks.line_time import fastest_line
from deepracer_exp.tracks.track import Track

from .report import benchmark_parser, number, table, with_exit_code, write_json


def records() -> dict[tuple[str, str], float]:
    """Return the fastest official lap in s by world and car."""
    fastest: dict[tuple[str, str], float] = {}
    for board in boards():
        key = board.world, board.car
        fastest[key] = min(board.record_s, fastest.get(key, board.record_s))
    return fastest


def ability(car: CarConfig) -> Ability:
    """Return what a car can do within its own limits."""
    full = np.deg2rad(car.max_steering_deg)
    return ability_of(car, np.array([car.min_speed_mps, -full]), np.array([car.max_speed_mps, full]))


def measure() -> list[dict[str, Any]]:
    """Return the record and the bound of each world and car."""
    rows, options = [], options_of("track")
    cars = {car: compose_experiment([f"car={car}"])[0].car for _, car in records()}
    abilities = {name: ability(car) for name, car in cars.items()}
    for (world, car), record_s in records().items():
        # Some worlds stand in the catalogue once for each direction only.
        option = next((name for name in (world, f"{world}_ccw") if name in options), None)
        if option is None:
            print(f"{world}: not in the catalogue", file=sys.stderr)
            continue
        track = Track.from_config(next(iter(compose_experiment([f"track={option}"])[0].tracks.values())))
        bound_s, _ = fastest_line(track, cars[car].reach_m, abilities[car])
        below = bool(bound_s < record_s)
        rows.append(
            {"world": world, "car": car, "record_s": record_s, "bound_s": round(bound_s, 3), "below": below}
        )
    return rows


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Compute, print and store."""
    options = benchmark_parser("lap_bounds", __doc__, None).parse_args(arguments)
    rows = measure()
    print(
        table(
            ("world", "car", "record (s)", "bound (s)", "share"),
            [
                (
                    row["world"],
                    row["car"],
                    number(row["record_s"], 2),
                    number(row["bound_s"], 2),
                    number(row["bound_s"] / row["record_s"], 2),
                )
                for row in rows
            ],
        )
    )
    below = sum(row["below"] for row in rows)
    print(f"\n{below} of {len(rows)}: the bound is below the record")
    write_json(options.json, {"worlds": rows, "below": below})


if __name__ == "__main__":
    sys.exit(main())
