"""Does a car that learned on six tracks drive tracks it has never seen? Against one that learned on a single track.

    python -m benchmarks.generalisation [--seeds 3] [--steps 1000000] [--json FILE] [OVERRIDE...]

For each seed two trainings of the same length run as `deepracer-exp train`, each car driving the courses both ways
round in turn (`direction: alternate`): one on the six SEEN tracks, one on ONE. Their best policies then drive each of
the twelve tracks, forward and reversed, one lap from each of 20 starts spread evenly over the lap, always taking the
most probable action. Completion is the mean share of the lap that was driven (0 to 1); laps is the share of complete
laps.

The tracks were chosen by a rule, before any result was looked at. Of the eighteen of `all_tracks`, the straight track
(its ends make it another task), the copies of reinvent_base with other floors, and the two widest, Monaco and
caecer_loop, are left out. The twelve that remain are sorted by width (then by name) and taken in pairs of neighbours.
The first pair gives its narrower track to SEEN, the second its wider one, and so on in turn, so that both lists have
about the same widths: 0.67 to 1.16 m, mean 0.91 m, and 0.72 to 1.07 m, mean 0.89 m.
"""

import dataclasses
import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.evaluation.evaluator import Evaluator

from .command import train
from .fresh import protocol, stored_policy
from .report import benchmark_parser, number, table, write_json

SEEN = (
    "Oval_track",
    "Virtual_May19_Train_track",
    "reinvent_base",
    "2022_summit_speedway",
    "Vegas_track",
    "Tokyo_Training_track",
)
UNSEEN = (
    "Canada_Training",
    "Bowtie_track",
    "AWS_track",
    "Spain_track",
    "reInvent2019_track",
    "reInvent2019_wide",
)
"""Neighbours of SEEN in width, in the same order."""
ONE = "reinvent_base"
"""The default track, one of SEEN."""
STARTS = 20
WANTED = 0.8
"""Completion on UNSEEN of the policy that learned on SEEN."""


class Driven(NamedTuple):
    """Laps on one track."""

    completion: float
    """Mean share of the lap."""
    laps: float
    """Share of complete laps."""


Policies = dict[str, dict[str, Driven]]
"""Of one seed, by policy (`six`, `one`) and track."""


def training_overrides(tracks: Sequence[str], seed: int, steps: int) -> list[str]:
    """Return the overrides of a training on tracks in both directions."""
    several = len(tracks) > 1
    return [
        f"track=[{','.join(tracks)}]" if several else f"track={tracks[0]}",
        *(f"track.{name}.direction=alternate" if several else "track.direction=alternate" for name in tracks),
        *("stopping=none", "checkpoints.every=null", "tracking=off"),
        *(f"budget.env_steps={steps}", f"seed={seed}"),
    ]


def drive(run: Path, tracks: Sequence[str], starts: int = STARTS) -> dict[str, Driven]:
    """Let a run's best policy drive tracks both ways, once from each start."""
    torch.set_num_threads(1)
    experiment, policy = stored_policy(run)
    driven_on = compose_experiment([f"track=[{','.join(tracks)}]", "track.direction=alternate"])[0]
    config = protocol("evaluation=three_trials", "evaluation.held_out=null", f"evaluation.trials={starts}")
    evaluation = Evaluator(dataclasses.replace(experiment, track=driven_on.track), config)(policy)
    ways = {group.track: group for group in evaluation.groups}
    found = {}
    for track in tracks:
        both = [ways[track], ways[f"{track} reversed"]]
        completion = statistics.fmean(group.completion for group in both)
        found[track] = Driven(completion / 100, statistics.fmean(group.lap_share for group in both))
    return found


def measure(seed: int, steps: int, overrides: Sequence[str]) -> Policies:
    """Train both policies with one seed and return how each drives each track."""
    results: Policies = {}
    for policy, tracks in (("six", SEEN), ("one", (ONE,))):
        with tempfile.TemporaryDirectory() as folder:
            run = train([*training_overrides(tracks, seed, steps), *overrides], Path(folder))
            results[policy] = drive(run, (*SEEN, *UNSEEN))
    return results


def figures(policy: str, tracks: Sequence[str], seeds: Sequence[Policies]) -> dict[str, float]:
    """Return the means of a policy over tracks and seeds."""
    driven = [seed[policy][track] for seed in seeds for track in tracks]
    return {name: round(statistics.fmean(getattr(one, name) for one in driven), 4) for name in Driven._fields}


def summarize(seeds: Sequence[Policies]) -> dict[str, Any]:
    """Return the means over seeds and tracks, and those of each seed and of each track."""

    def both(policy: str, of: Sequence[Policies]) -> dict[str, float]:
        return {
            f"{kind}_{key}": value
            for kind, tracks in (("unseen", UNSEEN), ("seen", SEEN))
            for key, value in figures(policy, tracks, of).items()
        }

    return {
        **both("six", seeds),
        "one_track": {"track": ONE, **both("one", seeds)},
        "seeds": [{"six_tracks": both("six", [seed]), "one_track": both("one", [seed])} for seed in seeds],
        "tracks": [
            {
                "track": track,
                "seen": track in SEEN,
                "six_tracks": figures("six", [track], seeds),
                "one_track": figures("one", [track], seeds),
            }
            for track in (*SEEN, *UNSEEN)
        ],
    }


def markdown(summary: dict[str, Any]) -> str:
    """Return the table of completion by track."""
    head = ("track", "learned on six", "laps", f"learned on {ONE}", "laps")

    def line(name: str, six: dict[str, float], one: dict[str, float], kind: str = "") -> tuple[str, ...]:
        return (name, *(number(of[f"{kind}{key}"], 3) for of in (six, one) for key in ("completion", "laps")))

    rows = [
        line(f"`{row['track']}`" + (" (seen)" if row["seen"] else ""), row["six_tracks"], row["one_track"])
        for row in summary["tracks"]
    ]
    means = [
        line(f"mean of the six {kind}", summary, summary["one_track"], f"{kind}_")
        for kind in ("seen", "unseen")
    ]
    return table(head, [*rows, *means])


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("generalisation", __doc__)
    parser.add_argument("--seeds", type=int, default=3, help="runs of each, with the seeds 0, 1, ...")
    parser.add_argument("--steps", type=int, default=1_000_000, help="control steps of a training")
    options = parser.parse_args(arguments)
    seeds = []
    for seed in range(options.seeds):
        seeds.append(measure(seed, options.steps, options.overrides))
        print(f"seed {seed}\n{markdown(summarize(seeds[-1:]))}", flush=True)
    summary = summarize(seeds)
    print(f"\n{markdown(summary)}\n\nwanted: {WANTED} on the unseen after learning on six")
    write_json(
        options.json, {**summary, "wanted": WANTED, "steps": options.steps, "overrides": options.overrides}
    )


if __name__ == "__main__":
    main()
