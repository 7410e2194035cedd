"""Does a camera policy drive under conditions it has never seen? With and without image randomization in training.

    python -m benchmarks.picture_conditions [--seeds 5] [--steps 200000] [--json FILE] [OVERRIDE...]

For each seed two trainings of the same length run as `deepracer-exp train observation=camera_small`: one always sees
the same picture of a place, the other trains with the pictures of `randomization=sim2real` (`randomization.pictures`
alone: both drive the same car). Their last policies then drive laps from 20 starts spread evenly over the lap, always
taking the most probable action, under each of these conditions:

- `usual`: none of it;
- `trained on`: every quantity drawn from the range that the second has trained with;
- one quantity at a time, all others off, half a range beyond the range's end: below and above it, where values beyond
  that end make sense. Neither has ever seen these.
- `all beyond`: every quantity drawn from a range of twice the width.

Completion is the mean share of the lap that was driven, 0 to 1. Intervals are those of the mean over seeds (95%, t).
"""

import dataclasses
import json
import math
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.driving import PictureRandomizationConfig
from deepracer_exp.config.overrides import override_line
from deepracer_exp.evaluation.evaluator import Evaluator

from .command import train
from .fresh import protocol, stored_policy
from .report import benchmark_parser, interval_text, mean_and_interval, number, table, write_json

STARTS = 20
LIMITS = {"scale": (0.5, 2.0), "objects": (0, 50)} | dict.fromkeys(
    ("noise", "light", "blur", "dirt"), (0.0, 1.0)
)
"""Values that make sense, by the end of a quantity's name; others have no limits."""


def limits(name: str) -> tuple[float, float]:
    """Return the least and the largest value of a quantity that make sense."""
    return next((ends for word, ends in LIMITS.items() if name.endswith(word)), (-math.inf, math.inf))


def conditions(trained: PictureRandomizationConfig) -> dict[str, PictureRandomizationConfig | None]:
    """Return the conditions by name."""
    ranges = {name: tuple(ends) for name, ends in vars(trained).items()}
    found: dict[str, PictureRandomizationConfig | None] = {"usual": None, "trained on": trained}
    wide = {}
    for name, (low, high) in ranges.items():
        least, largest = limits(name)
        half = 0.5 * (high - low)
        beyond = (max(low - half, least), min(high + half, largest))
        wide[name] = beyond
        for end, value in zip((low, high), beyond, strict=True):
            if value != end:
                found[f"{name} {value:g}"] = PictureRandomizationConfig(**{name: (value, value)})
    found["all beyond"] = PictureRandomizationConfig(**wide)
    return found


def drive(run: Path, under: dict[str, PictureRandomizationConfig | None]) -> dict[str, float]:
    """Let a run's last policy drive under each condition; return the completion."""
    torch.set_num_threads(1)
    stored, policy = stored_policy(run, "last")
    conditions = ("evaluation.usual=null", "evaluation.held_out=null")
    config = protocol("evaluation=three_trials", f"evaluation.trials={STARTS}", *conditions)
    completion = {}
    for name, pictures in under.items():
        randomization = dataclasses.replace(stored.randomization, pictures=pictures)
        experiment = dataclasses.replace(stored, randomization=randomization)
        (group,) = Evaluator(experiment, config)(policy).groups
        completion[name] = group.completion / 100
    return completion


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("picture_conditions", __doc__)
    parser.add_argument("--seeds", type=int, default=5, help="trainings of each, with the seeds 0, 1, ...")
    parser.add_argument("--steps", type=int, default=200_000, help="control steps of a training")
    options = parser.parse_args(arguments)
    trained = compose_experiment(["randomization=sim2real"])[0].randomization.pictures
    assert trained is not None
    under = conditions(trained)
    ranges = {name: list(ends) for name, ends in vars(trained).items()}
    ways = {"without": [], "with": [override_line("randomization.pictures", ranges)]}
    driven: dict[str, list[dict[str, float]]] = {way: [] for way in ways}
    fixed = ["observation=camera_small", "randomization=none", "stopping=none", "checkpoints.every=null"]
    fixed += ["tracking=off"]
    for seed in range(options.seeds):
        for way, own in ways.items():
            with tempfile.TemporaryDirectory() as folder:
                length = [f"budget.env_steps={options.steps}", f"seed={seed}"]
                run = train([*fixed, *own, *length, *options.overrides], Path(folder))
                driven[way].append(drive(run, under))
            print(f"seed {seed}, {way}: {json.dumps(driven[way][-1])}", flush=True)
    completion = {
        name: {way: mean_and_interval([one[name] for one in driven[way]]) for way in ways} for name in under
    }
    two_digits = partial(number, digits=2)
    rows = [
        (name, *(interval_text(one, two_digits) for one in by_way.values()))
        for name, by_way in completion.items()
    ]
    print()
    print(table(("condition", *(f"trained {way} it" for way in ways)), rows))
    result = {"completion": completion, "seeds": driven}
    write_json(options.json, {**result, "steps": options.steps, "overrides": options.overrides})


if __name__ == "__main__":
    main()
