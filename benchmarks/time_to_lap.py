"""Wall seconds until a car that learned from nothing drives a lap, and until it drives reliably.

    python -m benchmarks.time_to_lap [--seeds 3] [--json FILE] [OVERRIDE...]

For each seed, `deepracer-exp train stopping=reliable seed=K` runs as a process of its own in an empty folder, with
everything the default has: MLflow, trace, evaluations, checkpoints. Times count from the start of that process (imports
and start of the workers included) and are read from its summary.json:

- `first_lap_s`, `first_lap_steps`: the first complete lap. It is noticed at the end of the training iteration in
  which it was driven, so both figures are up to one iteration too large.
- `reliable_s`, `reliable_steps`: 90 per cent of the last 50 training episodes completed the lap (the stopping
  rule, which then ends the run). null where the budget ended the run before.

Steps are control steps over all cars. The median counts null as longer than anything.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .command import read_summary, train
from .report import benchmark_parser, median, number, table, write_json

WANTED_S = {"first_lap_s": 20.0, "reliable_s": 120.0}
"""Medians to stay below on two cores."""
CONSOLE_FIRST_LAP_STEPS = 19_472
"""Of a training on the AWS console on reinvent_base with 14 actions of 1 to 2 m/s, counted in its log."""
FIGURES = ("first_lap_s", "first_lap_steps", "reliable_s", "reliable_steps")


def measure(seed: int, overrides: Sequence[str]) -> dict[str, Any]:
    """Train with one seed."""
    with tempfile.TemporaryDirectory() as place:
        summary = read_summary(train(["stopping=reliable", *overrides, f"seed={seed}"], Path(place)))
    moments = {"first_lap": summary["first_lap"] or {}, "reliable": summary["reliable"] or {}}
    figures: dict[str, Any] = {"seed": seed}
    for name, moment in moments.items():
        figures[f"{name}_s"] = moment.get("since_process_start_s")
        figures[f"{name}_steps"] = moment.get("env_steps")
    return figures


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("time_to_lap", __doc__)
    parser.add_argument("--seeds", type=int, default=3, help="number of runs, with the seeds 0, 1, ...")
    options = parser.parse_args(arguments)
    seeds = []
    for seed in range(options.seeds):
        seeds.append(measure(seed, options.overrides))
        print(f"seed {seed}: " + ", ".join(f"{key} {number(seeds[-1][key])}" for key in FIGURES), flush=True)
    medians = {f"median_{key}": median([row[key] for row in seeds]) for key in FIGURES}
    rows = [
        (str(row["seed"]), *(number(row[key], 1 if key.endswith("_s") else 0) for key in FIGURES))
        for row in seeds
    ]
    middle = (number(medians[f"median_{key}"], 1 if key.endswith("_s") else 0) for key in FIGURES)
    wanted = (number(WANTED_S.get(key)) for key in FIGURES)
    console = (number(CONSOLE_FIRST_LAP_STEPS if key == "first_lap_steps" else None) for key in FIGURES)
    head = ("seed", "first lap (s)", "first lap (steps)", "reliable (s)", "reliable (steps)")
    rows += [("median", *middle), ("wanted, at most", *wanted), ("a run of the AWS console", *console)]
    print(f"\n{table(head, rows)}")
    given = {"overrides": options.overrides}
    write_json(options.json, {"seeds": seeds, **medians, "wanted": WANTED_S, **given})


if __name__ == "__main__":
    main()
