"""Races of a self-play policy after its training against the policies that it was on the way.

    python -m benchmarks.head_to_head [--races 200] [--work DIR] [--json FILE] [OVERRIDE...]

`deepracer-exp train experiment=head_to_head` runs with its checkpoints kept, in a temporary folder or in DIR, where a
finished run with the same overrides is used. Its last policy then races (`evaluation=head_to_head`: three laps, each
start twice with exchanged places) against

- the policy that the training began with, the first of its pool: `began`;
- every checkpoint of an evaluation: `checkpoints`.

`won` is the share of races won, a draw counting half, with its 95% interval by bootstrap over the races;
`crash_free` the share of its laps without running into the rival, `lap_s` and `rival_lap_s` the means of complete laps
in these races and in races of the rival against itself, penalties included. Wanted: at least 70% against `began`.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from deepracer_exp.config.compose import compose_evaluation
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.runs.checkpoints import networks_of
from deepracer_exp.runs.stored_run import StoredRun

from .command import trained
from .report import benchmark_parser, number, table, with_exit_code, write_json

WANTED = 0.7
TIME_S = 60.0
"""Duration of a race in which neither car finishes; a policy that has learned nothing finishes none."""
_KEPT = ("experiment=head_to_head", "checkpoints.keep=1000", "report=false", "tracking=off")


def first_policy(experiment: Experiment) -> torch.nn.Module:
    """Return the policy with which a training of the experiment begins."""
    return networks_of(experiment, torch.Generator().manual_seed(experiment.seed)).policy


def race(evaluator: Evaluator, policy: torch.nn.Module, rival: torch.nn.Module) -> dict[str, Any]:
    """Return the figures of the races of a policy against another."""
    group = evaluator(policy, rival=rival).groups[0]
    alone = evaluator(rival).groups[0]
    won = group.statistics()["won"]
    return {
        "won": won["mean"],
        "interval": won["interval"],
        "crash_free": group.crash_free_share,
        "lap_s": group.mean_lap_time_s,
        "rival_lap_s": alone.mean_lap_time_s,
    }


def measure(run: StoredRun, races: int) -> dict[str, Any]:
    """Race the last policy of a finished run against the earlier ones."""
    torch.set_num_threads(1)
    config = compose_evaluation(["evaluation=head_to_head"])[0].evaluation
    evaluator = Evaluator(run.experiment, replace(config, trials=races, time_s=TIME_S))
    last = run.with_policy("last").read_policy()
    figures = {"began": race(evaluator, last.networks.policy, first_policy(run.experiment))}
    names = [path.name for path in sorted(run.checkpoints.glob("[0-9]*")) if path.name < last.path.name]
    checkpoints = {}
    for name in names:
        rival = run.with_policy(name).read_policy().networks.policy
        checkpoints[name] = race(evaluator, last.networks.policy, rival)
        print(f"against {name}: won {100 * checkpoints[name]['won']:.0f} %", flush=True)
    return {**figures, "checkpoints": checkpoints, "races": races, "wanted": WANTED}


def row(name: str, figures: dict[str, Any]) -> tuple[str, ...]:
    """Return a line of the table."""
    low, high = figures["interval"]
    return (
        name,
        f"{100 * figures['won']:.0f} ({100 * low:.0f} to {100 * high:.0f})",
        f"{100 * figures['crash_free']:.0f}",
        number(figures["lap_s"], 2),
        number(figures["rival_lap_s"], 2),
    )


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("head_to_head", __doc__)
    parser.add_argument("--races", type=int, default=200, help="races against each policy")
    parser.add_argument("--work", type=Path, help="folder of the training, which is kept")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as place:
        run = StoredRun(trained(options.work or Path(place), [*_KEPT, *options.overrides]))
        figures = measure(run, options.races)
    lines = [("the policy it began with", figures["began"])]
    lines += [(f"after iteration {int(name)}", found) for name, found in figures["checkpoints"].items()]
    head = ("rival", "races won %", "laps without a crash %", "lap s", "rival alone s")
    print(f"\n{table(head, [row(*line) for line in lines])}")
    write_json(options.json, {**figures, "overrides": options.overrides})


if __name__ == "__main__":
    raise SystemExit(main())
