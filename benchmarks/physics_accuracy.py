"""What each physics setting costs, and how far it ends from a 0.5 ms reference of the same model.

    python -m benchmarks.physics_accuracy [--cars 64] [--json FILE]

Every setting drives the same cars with the same random commands. A setting that changes the model (wheel
shape, contact stiffness, slip) is held against a reference of that model. Costs are taken in turns, so that
their ratios within one run are fair.
"""

import dataclasses
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import RunFailed
from deepracer_exp.sim.batch import CarBatch

from .report import benchmark_parser, number, table, write_json

SECONDS = 10
REFERENCE_STEP_S = 0.0005
MODEL_KEYS = ("wheel_contact", "contact_time_s", "contact_impedance", "rear_slip_time_s")
"""Settings that change what is simulated, not how exactly."""

SETTINGS: tuple[dict[str, Any], ...] = (
    {},
    *({"substeps": n} for n in (4, 5, 6, 7, 10, 14, 20, 40)),
    *({"integrator": "discrete", "substeps": n} for n in (5, 10)),
    *({"integrator": "euler", "substeps": n} for n in (5, 10, 20)),
    *({"solver_iterations": n} for n in (1, 2, 3)),
    *({"line_search_iterations": n} for n in (2, 4, 20)),
    *({"solver_tolerance": tolerance} for tolerance in (1e-8, 1e-4, 1e-2)),
    *({"solver_iterations": n} for n in (8, 20)),
    *({"solver": "newton", "solver_iterations": n} for n in (2, 4, 8)),
    *({"contact_impedance": rigid} for rigid in (0.3, 0.7)),
    *({"contact_time_s": seconds} for seconds in (0.03, 0.05)),
    *({"rear_slip_time_s": seconds} for seconds in (0.04, 0.06)),
    # MuJoCo's own contact stiffness needs a step of at most 10 ms.
    {"contact_time_s": 0.02, "contact_impedance": 0.9, "substeps": 10},
    {"contact_time_s": 0.02, "contact_impedance": 0.9, "substeps": 10, "solver_iterations": 8},
    {"wheel_contact": "ellipsoid"},
    {"wheel_contact": "cylinder"},
)
Array = NDArray[np.float64]


def commands(n_cars: int, steps: int) -> tuple[Array, Array]:
    """Return speeds (m/s) and steering angles (rad), (steps, n_cars): new ones after 1 to 8 steps."""
    rng = np.random.default_rng(0)
    speed, steering = np.empty((steps, n_cars)), np.empty((steps, n_cars))
    for car in range(n_cars):
        at = 0
        while at < steps:
            until = at + int(rng.integers(1, 9))
            speed[at:until, car] = rng.uniform(0.5, 3.0)
            steering[at:until, car] = np.deg2rad(rng.uniform(-30.0, 30.0))
            at = until
    return speed, steering


def path(car: CarConfig, speed: Array, steering: Array) -> Array | None:
    """Return the origins (steps, n_cars, 2) in metres, or None where the physics blows up."""
    cars = CarBatch(car, speed.shape[1], threads=0)
    places = np.empty((*speed.shape, 2))
    try:
        for t, command in enumerate(zip(speed, steering, strict=True)):
            cars.drive(*command)
            state = cars.read()
            places[t] = np.stack([state.x_m, state.y_m], axis=-1)
    except RunFailed:
        return None
    return places


def costs_us(cars: list[CarConfig], speed: Array, steering: Array, rounds: int) -> list[float]:
    """Return the median microseconds per control step and car, one thread, all settings in turns.

    The median, not the least: a sliding car costs the solver up to twice as much as one that rolls.
    """
    batches = [CarBatch(car, speed.shape[1], threads=1) for car in cars]
    turns: list[list[float]] = [[] for _ in cars]
    for batch in batches:
        batch.drive(speed[0], steering[0])
    for t in range(1, rounds + 1):
        for i, batch in enumerate(batches):
            begin = time.perf_counter()
            batch.drive(speed[t], steering[t])
            turns[i].append(time.perf_counter() - begin)
    return [1e6 * float(np.median(seconds)) / speed.shape[1] for seconds in turns]


def measure(n_cars: int, rounds: int) -> list[dict[str, Any]]:
    """Measure every setting; errors in metres, median and 90th percentile over cars."""
    default = compose_experiment(["car=deepracer"])[0].car
    steps = int(SECONDS * default.control_hz)
    speed, steering = commands(n_cars, steps)
    references: dict[tuple[Any, ...], Array] = {}
    rows, timed = [], []
    for change in SETTINGS:
        car = dataclasses.replace(default, **change)
        model = tuple(getattr(car, key) for key in MODEL_KEYS)
        if model not in references:
            exact = dataclasses.replace(
                car,
                substeps=round(car.control_period_s / REFERENCE_STEP_S),
                integrator="implicitfast",
                solver="newton",
                solver_iterations=100,
                line_search_iterations=50,
                solver_tolerance=1e-12,
            )
            reference = path(exact, speed, steering)
            if reference is None:
                raise RunFailed(f"the reference of {model} blew up")
            references[model] = reference
        driven = path(car, speed, steering)
        row: dict[str, Any] = {
            "setting": ", ".join(f"{key}={value}" for key, value in change.items()) or "default",
        }
        for seconds in (1, SECONDS):
            at = int(seconds * default.control_hz) - 1
            error = None if driven is None else np.linalg.norm(driven[at] - references[model][at], axis=-1)
            row[f"median_{seconds}s_m"] = None if error is None else float(np.median(error))
            row[f"p90_{seconds}s_m"] = None if error is None else float(np.percentile(error, 90))
        rows.append(row)
        if driven is not None:
            timed.append((row, car))
    for (row, _), cost in zip(
        timed, costs_us([car for _, car in timed], speed, steering, rounds), strict=True
    ):
        row["us_per_step"] = cost
    return rows


def markdown(rows: list[dict[str, Any]]) -> str:
    """Return the table of the settings."""
    head = (
        "setting (otherwise default)",
        "after 1 s: median, p90 (mm)",
        "after 10 s: median, p90 (mm)",
        "µs",
    )

    def error(row: dict[str, Any], seconds: int) -> str:
        median, high = row[f"median_{seconds}s_m"], row[f"p90_{seconds}s_m"]
        return "blows up" if median is None else f"{1e3 * median:.1f}, {1e3 * high:.1f}"

    return table(
        head,
        [
            (row["setting"], error(row, 1), error(row, SECONDS), number(row.get("us_per_step"), 1))
            for row in rows
        ],
    )


def main() -> None:
    """Measure and print."""
    parser = benchmark_parser("physics_accuracy", __doc__, None)
    parser.add_argument("--cars", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=60, help="timed control steps per setting")
    options = parser.parse_args()
    rows = measure(options.cars, options.rounds)
    print(markdown(rows))
    write_json(options.json, {"settings": rows, "cars": options.cars})


if __name__ == "__main__":
    main()
