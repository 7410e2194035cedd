"""How far cars with few physics steps in a control period end from cars with ten times as many, and what steps cost.

    python -m benchmarks.physics_accuracy [--car NAME] [--cars 64] [--json FILE]

All drive the same random commands: 0.5 to 4 m/s, up to 30 degrees to either side, held for 1 to 8 control steps.
"""

import dataclasses
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.recorded import car_named
from benchmarks.report import benchmark_parser, number, table, with_exit_code, write_json
from deepracer_exp.config.car import CarConfig
from deepracer_exp.sim.batch import CarBatch

Array = NDArray[np.float64]
SUBSTEPS = (2, 3, 5, 10, 20)
REFERENCE = 50
SECONDS = (1, 3)


def commands(n_cars: int, steps: int) -> tuple[Array, Array]:
    """Return speeds (m/s) and steering angles (rad), (steps, n_cars): new ones after 1 to 8 steps."""
    rng = np.random.default_rng(0)
    speed, steering = np.empty((steps, n_cars)), np.empty((steps, n_cars))
    for car in range(n_cars):
        at = 0
        while at < steps:
            until = at + int(rng.integers(1, 9))
            speed[at:until, car] = rng.uniform(0.5, 4.0)
            steering[at:until, car] = np.deg2rad(rng.uniform(-30.0, 30.0))
            at = until
    return speed, steering


def path(car: CarConfig, speed: Array, steering: Array) -> tuple[Array, float]:
    """Return the origins after each step, (steps, n_cars, 2), and microseconds a control step and car, one thread."""
    cars = CarBatch(car, speed.shape[1], threads=1)
    places, seconds = np.empty((*speed.shape, 2)), []
    for step, command in enumerate(zip(speed, steering, strict=True)):
        begin = time.perf_counter()
        cars.drive(*command)
        seconds.append(time.perf_counter() - begin)
        places[step] = np.stack(cars.read()[:2], axis=-1)
    return places, 1e6 * float(np.median(seconds)) / speed.shape[1]


def measure(name: str, n_cars: int) -> list[dict[str, Any]]:
    """Return a row for each number of substeps; errors in metres, median and 90th percentile over cars."""
    car = car_named(name)
    speed, steering = commands(n_cars, round(max(SECONDS) * car.control_hz))
    exact, _ = path(dataclasses.replace(car, substeps=REFERENCE), speed, steering)
    rows = []
    for substeps in SUBSTEPS:
        places, cost_us = path(dataclasses.replace(car, substeps=substeps), speed, steering)
        row: dict[str, Any] = {"substeps": substeps, "us_per_step": cost_us}
        for seconds in SECONDS:
            at = round(seconds * car.control_hz) - 1
            off = np.linalg.norm(places[at] - exact[at], axis=-1)
            row[f"median_{seconds}s_m"], row[f"p90_{seconds}s_m"] = map(float, np.quantile(off, [0.5, 0.9]))
        rows.append(row)
    return rows


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("physics_accuracy", __doc__, None)
    parser.add_argument("--car", default="deepracer", help="the simulated car (an option of conf/car)")
    parser.add_argument("--cars", type=int, default=64)
    options = parser.parse_args(arguments)
    rows = measure(options.car, options.cars)
    head = ("substeps", *(f"after {seconds} s: median, p90 (mm)" for seconds in SECONDS), "µs")
    lines = [
        (
            str(row["substeps"]),
            *(f"{1e3 * row[f'median_{s}s_m']:.1f}, {1e3 * row[f'p90_{s}s_m']:.1f}" for s in SECONDS),
            number(row["us_per_step"], 1),
        )
        for row in rows
    ]
    print(table(head, lines))
    write_json(options.json, {"substeps": rows, "cars": options.cars, "car": options.car})


if __name__ == "__main__":
    sys.exit(main())
