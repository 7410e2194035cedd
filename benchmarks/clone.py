"""What does each kind of clone bring?

    python -m benchmarks.clone [--seeds 5] [--steps 1000000] [--more 500000] [--jobs 2] [--json FILE] [OVERRIDE...]

For each seed `deepracer-exp train` runs the default experiment for `--steps` control steps, whatever a stopping rule
would say, so that all parents are of the same age. Its best checkpoint is then cloned three times, each time with a
fresh optimizer, for `--more` steps: by `deepracer-exp clone RUN`, which lowers the learning rate to a tenth; with
algorithm.lr as it was; and with `randomization=sim2real` at a tenth. The best checkpoint of each of the four drives 64
laps on usual and 64 on held-out conditions, with starts and draws that no evaluation of the training had. OVERRIDE
changes the parents, e.g. `randomization=none`.

Figures are means over seeds with Student's 95% interval; `minutes` is the wall time of a training, `--jobs` at once.
All clones have the same parent, so that their differences within a seed say more than those of the means:
`tenth_minus_parent` and the like.
"""

import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from .command import at_once, read_summary, train
from .fresh import TRIALS, drive
from .report import benchmark_parser, interval_text, mean_and_interval, number, table, write_json

CLONES = ("tenth", "same", "sim2real")
POLICIES = ("parent", *CLONES)
"""The trained run, and its clones by what they change."""
FIGURES = ("lap_time_s", "completion", "lap_share", "held_out_lap_time_s", "held_out_completion", "minutes")


def train_family(folder: Path, seed: int, steps: int, more: int, overrides: Sequence[str]) -> dict[str, Path]:
    """Train a parent and its clones in `folder` and return their runs."""
    folder.mkdir()
    always = ("stopping=none", "tracking=off")
    parent = train([*overrides, *always, f"budget.env_steps={steps}", f"seed={seed}"], folder)
    cloned = [str(parent), f"budget.env_steps={more}"]
    return {
        "parent": parent,
        "tenth": train(cloned, folder, "clone"),
        "same": train([*cloned, f"algorithm.lr={learning_rate(parent)}"], folder, "clone"),
        "sim2real": train([*cloned, "randomization=sim2real"], folder, "clone"),
    }


def measure(run: Path) -> dict[str, Any]:
    """Let a run's best policy drive."""
    summary = read_summary(run)
    return {
        "lr": learning_rate(run),
        "env_steps": summary["env_steps"],
        "best_iteration": summary["best"]["iteration"],
        "minutes": summary["wall_clock_s"] / 60,
        **asdict(drive(run, ["best"])[0]),
    }


def learning_rate(run: Path) -> float:
    """Return the learning rate that a run was started with."""
    config = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
    return float(config["algorithm"]["lr"])


def summarize(seeds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return means and intervals over seeds, of each policy and of the differences within a seed."""

    def difference(name: str, figure: str) -> list[float | None]:
        pairs = [(seed[name][figure], seed["parent"][figure]) for seed in seeds]
        return [None if None in pair else pair[0] - pair[1] for pair in pairs]

    return {
        **{
            name: {figure: mean_and_interval([seed[name][figure] for seed in seeds]) for figure in FIGURES}
            for name in POLICIES
        },
        **{
            f"{name}_minus_parent": {
                figure: mean_and_interval(difference(name, figure)) for figure in FIGURES
            }
            for name in CLONES
        },
    }


def markdown(seeds: Sequence[dict[str, Any]], summary: dict[str, Any]) -> str:
    """Return the table of seeds, means and differences."""
    head = ("", "lap (s)", "done (%)", "complete laps", "held-out lap (s)", "held-out done (%)", "minutes")
    show = {
        name: partial(number, digits=digits) for name, digits in zip(FIGURES, (2, 1, 2, 2, 1, 1), strict=True)
    }
    rows = [
        (f"seed {seed['seed']}, {name}", *(show[figure](seed[name][figure]) for figure in FIGURES))
        for seed in seeds
        for name in POLICIES
    ]
    for name, figures in summary.items():
        cells = (interval_text(figures[figure], show[figure]) for figure in FIGURES)
        rows.append((name.replace("_", " "), *cells))
    return table(head, rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("clone", __doc__)
    parser.add_argument("--seeds", type=int, default=5, help="number of parents, with the seeds 0, 1, ...")
    parser.add_argument("--steps", type=int, default=1_000_000, help="control steps of a parent")
    parser.add_argument("--more", type=int, default=500_000, help="control steps of each clone")
    parser.add_argument("--jobs", type=int, default=2, help="seeds at once")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        places = {seed: Path(temporary) / str(seed) for seed in range(options.seeds)}
        how = (options.steps, options.more, options.overrides)
        families = at_once(
            options.jobs, [partial(train_family, folder, seed, *how) for seed, folder in places.items()]
        )
        seeds = [
            {"seed": seed, **{name: measure(run) for name, run in family.items()}}
            for seed, family in zip(places, families, strict=True)
        ]
    summary = summarize(seeds)
    print(f"\n{markdown(seeds, summary)}")
    given = {"steps": options.steps, "more": options.more, "trials": TRIALS, "overrides": options.overrides}
    result = {**summary, **given, "seeds": seeds}
    write_json(options.json, result)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
