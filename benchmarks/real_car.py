"""What does a camera policy lose between the simulator and the physical car, trained with and without `sim2real`?

    python -m benchmarks.real_car [--seeds 5] [--folder FOLDER] [--json FILE] [OVERRIDE...]

For each seed a policy that sees features is trained for TEACHER_STEPS with `randomization=sim2real`. From it two
policies learn that see what the car sees (`observation=camera`), ITERATIONS of `algorithm=distill` each, at a falling
learning rate: one in the simulator as it is, one with `randomization=sim2real`. Their last policies then drive laps
from STARTS starts spread evenly over the lap under `evaluation=real_car`: as in the simulator, with each of the car's
differences from it alone, and with all of them.

`lap_share` is the share of complete laps, `completion` the mean share of the lap that was driven, `lap_time_s` the mean
of the complete laps. Intervals are those of the mean over seeds (95%, t); `gain` is with minus without, seed by seed.

FOLDER keeps runs and results, so that a second call continues the first; overrides are those of the two policies.
"""

import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from deepracer_exp.evaluation.evaluate import car_figures, race_car_parts
from deepracer_exp.evaluation.evaluator import Evaluator

from .command import trained
from .fresh import protocol, stored_policy
from .report import benchmark_parser, interval_text, mean_and_interval, number, percent, table, write_json

TEACHER_STEPS, ITERATIONS, STARTS = 300_000, 40, 20
WAYS: dict[str, list[str]] = {"without": [], "with": ["randomization=sim2real"]}
FIGURES = ("lap_share", "completion", "lap_time_s")

Figures = dict[str, dict[str, Any]]


def drive(run: Path) -> Figures:
    """Let a run's last policy drive as in the simulator and as on the car."""
    experiment, policy = stored_policy(run, "last")
    config = protocol("evaluation=real_car", f"evaluation.trials={STARTS}")
    return car_figures(race_car_parts(experiment, config, policy, Evaluator(experiment, config)(policy)))


def measure(folder: Path, seed: int, overrides: Sequence[str]) -> dict[str, Figures]:
    """Train and drive with one seed whatever the folder does not have yet."""
    folder.mkdir(parents=True, exist_ok=True)
    every = ["stopping=none", "checkpoints.every=null", "tracking=off", "report=false", f"seed={seed}"]
    driven = {}
    for way, randomization in WAYS.items():
        result = folder / f"{way}.json"
        if not result.exists():
            length = f"budget.env_steps={TEACHER_STEPS}"
            teacher = trained(folder, ["name=teacher", *every, length, "randomization=sim2real"])
            student = [
                *(f"name={way}", f"teacher={teacher.resolve()}", "observation=camera", "lr_schedule=linear"),
                *("algorithm=distill", f"algorithm.teacher_iterations={ITERATIONS}"),
                *(f"budget.iterations={ITERATIONS}", "budget.env_steps=null"),
            ]
            run = trained(folder, [*student, *every, *randomization, *overrides])
            began = time.monotonic()
            result.write_text(json.dumps(drive(run), indent=2) + "\n", encoding="utf-8")
            print(f"{folder.name}: {way} driven in {time.monotonic() - began:.0f} s", flush=True)
        driven[way] = json.loads(result.read_text(encoding="utf-8"))
    return driven


def summarize(seeds: Sequence[dict[str, Figures]]) -> dict[str, Any]:
    """Return mean and interval of each figure with, without, and of the gain, by what is as on the car."""
    found: dict[str, Any] = {}
    for name in seeds[0]["with"]:
        found[name] = {}
        for figure in FIGURES:
            pairs = [{way: seed[way][name][figure] for way in WAYS} for seed in seeds]
            gains = [None if None in pair.values() else pair["with"] - pair["without"] for pair in pairs]
            found[name][figure] = {
                **{way: mean_and_interval([pair[way] for pair in pairs]) for way in WAYS},
                "gain": mean_and_interval(gains),
            }
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("real_car", __doc__)
    parser.add_argument("--seeds", type=int, default=5, help="trainings of each, with the seeds 0, 1, ...")
    parser.add_argument(
        "--folder", type=Path, default=Path("real_car"), help="of the runs (default: real_car)"
    )
    options = parser.parse_args(arguments)
    seeds = [
        measure(options.folder / f"seed{seed}", seed, options.overrides) for seed in range(options.seeds)
    ]
    found = summarize(seeds)
    columns: dict[tuple[str, str], Callable[[float | None], str]] = {
        ("complete laps", "lap_share"): percent,
        ("lap (s)", "lap_time_s"): partial(number, digits=2),
    }
    head = ["as on the car", *(f"{what}, trained {way}" for what, _ in columns for way in WAYS)]
    rows = [
        (
            {"simulator": "nothing", "car": "all"}.get(name, name),
            *(interval_text(one[figure][way], show) for (_, figure), show in columns.items() for way in WAYS),
        )
        for name, one in found.items()
    ]
    print(f"\n{table(head, rows)}")
    given = {"teacher_steps": TEACHER_STEPS, "iterations": ITERATIONS, "starts": STARTS}
    result = {"figures": found, "seeds": seeds, **given, "overrides": options.overrides}
    write_json(options.json, result)


if __name__ == "__main__":
    main()
