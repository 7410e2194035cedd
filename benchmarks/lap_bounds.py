"""How fast a perfect driver could lap, beside the records of the service's leaderboards.

    python -m benchmarks.lap_bounds --anchors FILE.csv [--car NAME] [--json FILE]

FILE.csv has a row for each board: columns world, race_type, date and best_lap_s; time trials since March 2020 count,
when commands went up to 4 m/s. For each world the least time of a flying lap is that of `tracks.line_time`, with all
that the car can do within its own limits. A bound above a record says that the simulated car cannot do what a car of
the service did.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.options import options_of
from deepracer_exp.sim.ability import ability_of
from deepracer_exp.tracks.line_time import fastest_line
from deepracer_exp.tracks.track import Track

from .report import benchmark_parser, number, table, with_exit_code, write_json

_SINCE = "2020-03"


def time_trials(file: Path) -> "pd.Series[float]":
    """Return the record of each world in s, by its name, from boards of time trials of the fast era."""
    boards = pd.read_csv(file)
    fast = boards[(boards["race_type"] == "TIME_TRIAL") & (boards["date"] >= _SINCE)]
    records: pd.Series[float] = fast.groupby("world")["best_lap_s"].min()
    return records


def measure(car: CarConfig, records: "pd.Series[float]") -> list[dict[str, Any]]:
    """Return each world's record and bound."""
    full = np.deg2rad(car.max_steering_deg)
    ability = ability_of(car, np.array([car.min_speed_mps, -full]), np.array([car.max_speed_mps, full]))
    rows, known = [], options_of("track")
    for world, record in records.items():
        # Some worlds stand in the catalogue once for each direction only.
        option = next((name for name in (world, f"{world}_ccw") if name in known), None)
        if option is None:
            print(f"{world}: not in the catalogue", file=sys.stderr)
            continue
        track = Track.from_config(next(iter(compose_experiment([f"track={option}"])[0].tracks.values())))
        bound, _ = fastest_line(track, car.reach_m, ability)
        rows.append(
            {"world": world, "record_s": record, "bound_s": round(bound, 3), "below": bool(bound < record)}
        )
    return rows


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Compute, print and store."""
    parser = benchmark_parser("lap_bounds", __doc__, None)
    parser.add_argument("--anchors", type=Path, required=True, help="records of leaderboards as CSV")
    parser.add_argument("--car", default="deepracer", help="the simulated car (an option of conf/car)")
    options = parser.parse_args(arguments)
    rows = measure(compose_experiment([f"car={options.car}"])[0].car, time_trials(options.anchors))
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
