"""Does a car that learned on six tracks drive tracks it has never seen? Against one that learned on a single track.

    python -m benchmarks.generalisation [--seeds 3] [--steps 1000000] [--json FILE] [OVERRIDE...]

For each seed two trainings of the same length run as `deepracer-exp train`, each car driving the courses both ways
round in turn (`direction: alternate`): one on the six SEEN tracks, one on ONE. Their best policies then drive each of
the twelve tracks, forward and reversed, from 20 starts spread evenly over the lap, always taking the most probable
action. Completion is the mean share of the lap that was driven until the episode ended (0 to 1); laps is the share of
complete laps.

The tracks were chosen by a rule, before any result was looked at. Of the eighteen of `all_tracks`, the straight track
(its ends make it another task), the copies of reinvent_base with other floors, and the two widest, Monaco and
caecer_loop, are left out. The twelve that remain are sorted by width (then by name) and taken in pairs of neighbours.
The first pair gives its narrower track to SEEN, the second its wider one, and so on in turn, so that both lists have
about the same widths: 0.67 to 1.16 m, mean 0.91 m, and 0.72 to 1.07 m, mean 0.89 m.
"""

import argparse
import statistics
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.checkpoint import Checkpoint
from torchrl.envs.utils import ExplorationType, set_exploration_type

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.agents.ppo import build_agent
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.deepracer.trace import PACKED, STATUS_CODE
from deepracer_exp.env.observation import feature_names
from deepracer_exp.env.race import Race
from deepracer_exp.env.setup import RaceSetup, build_setup

from .command import train
from .report import number, table, write_json

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


@dataclass(frozen=True)
class Driven:
    """Episodes on one track."""

    completion: float
    """Mean share of the lap."""
    laps: float
    """Share of complete laps."""


def training_overrides(tracks: Sequence[str], seed: int, steps: int) -> list[str]:
    """Return what is told to `deepracer-exp train`."""
    alternate = [f"track.{name}.direction=alternate" for name in tracks]
    if len(tracks) == 1:
        alternate = ["track.direction=alternate"]
    return [
        f"track=[{','.join(tracks)}]" if len(tracks) > 1 else f"track={tracks[0]}",
        *alternate,
        *(
            "stopping=none",
            "checkpoints.every=null",
            "tracking=off",
            f"budget.env_steps={steps}",
            f"seed={seed}",
        ),
    ]


def load_policy(checkpoint: Path, experiment: Experiment, setup: RaceSetup) -> TensorDictModuleBase:
    """Return the policy of a checkpoint."""
    networks = build_actor_critic(
        experiment.network, len(feature_names(experiment.observation)), setup.actions.n, torch.Generator()
    )
    agent = build_agent(networks, experiment.algorithm, experiment.lr_schedule, experiment.seed)
    Checkpoint(agent=agent).load(checkpoint)
    return networks.policy


def drive(
    checkpoint: Path, tracks: Sequence[str], overrides: Sequence[str], starts: int = STARTS
) -> dict[str, Driven]:
    """Let a policy drive tracks both ways, once from each start."""
    experiment, _ = compose_experiment(
        [f"track=[{','.join(tracks)}]", *overrides, "track.direction=alternate"]
    )
    setup = build_setup(experiment)
    course = np.repeat(np.arange(len(tracks)), starts)
    start_ndist = np.tile(np.arange(starts) / starts, len(tracks))
    race = Race(setup, len(course), threads=0)
    ends = _drive_both_ways(load_policy(checkpoint, experiment, setup), race, course, start_ndist)
    share = ends[:, :, PACKED["progress"]] / 100
    lap = ends[:, :, PACKED["episode_status"]] == STATUS_CODE["lap_complete"]
    return {
        track: Driven(float(share[:, course == place].mean()), float(lap[:, course == place].mean()))
        for place, track in enumerate(tracks)
    }


def _drive_both_ways(
    policy: TensorDictModuleBase, race: Race, course: np.ndarray, start_ndist: np.ndarray
) -> np.ndarray:
    """Return the last rows of each car's first two episodes, (2, cars, columns of the trace)."""
    race.reset(None, course, start_ndist)
    ends = np.zeros((2, *race.trace.shape))
    driven = np.zeros(race.n_cars, np.intp)
    with torch.inference_mode(), set_exploration_type(ExplorationType.MODE):
        while (driven < 2).any():
            seen = TensorDict({"observation": torch.from_numpy(race.observation)}, [race.n_cars])
            race.step(policy(seen)["action"].numpy())
            ended = np.flatnonzero(race.terminated | race.truncated)
            counted = ended[driven[ended] < 2]
            ends[driven[counted], counted] = race.trace[counted]
            driven[ended] += 1
            if len(ended):
                race.reset(ended, None, start_ndist[ended])
    return ends


def measure(seed: int, steps: int, overrides: Sequence[str]) -> dict[str, dict[str, Driven]]:
    """Train both policies with one seed and return how each drives each track."""
    results: dict[str, dict[str, Driven]] = {}
    for policy, tracks in (("six", SEEN), ("one", (ONE,))):
        with tempfile.TemporaryDirectory() as folder:
            run = train([*training_overrides(tracks, seed, steps), *overrides], Path(folder))
            checkpoints = run / "checkpoints"
            # A training too short to be ranked has no best.
            best = checkpoints / ("best" if (checkpoints / "best").exists() else "last")
            results[policy] = drive(best, (*SEEN, *UNSEEN), overrides)
    return results


def summarize(seeds: Sequence[dict[str, dict[str, Driven]]]) -> dict[str, Any]:
    """Return the means over seeds and tracks, and those of each seed and of each track."""

    def figures(
        policy: str, tracks: Sequence[str], of: Sequence[dict[str, dict[str, Driven]]]
    ) -> dict[str, float]:
        driven = [seed[policy][track] for seed in of for track in tracks]
        return {
            "completion": round(statistics.fmean(one.completion for one in driven), 4),
            "laps": round(statistics.fmean(one.laps for one in driven), 4),
        }

    def both(policy: str, of: Sequence[dict[str, dict[str, Driven]]]) -> dict[str, float]:
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
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        prog="benchmarks.generalisation",
    )
    parser.add_argument(
        "--seeds", type=int, default=3, help="number of runs of each, with the seeds 0, 1, ..."
    )
    parser.add_argument(
        "--steps", type=int, default=1_000_000, help="control steps of a training, over all cars"
    )
    parser.add_argument("--json", type=Path, help="also write the figures as JSON to this file")
    parser.add_argument("overrides", nargs="*", metavar="OVERRIDE", help="as for deepracer-exp train")
    options = parser.parse_args(arguments)
    seeds = []
    for seed in range(options.seeds):
        seeds.append(measure(seed, options.steps, options.overrides))
        told = summarize(seeds[-1:])
        print(
            f"seed {seed}: unseen {told['unseen_completion']:.3f}, seen {told['seen_completion']:.3f}; learned on "
            f"{ONE} alone: {told['one_track']['unseen_completion']:.3f}, {told['one_track']['seen_completion']:.3f}",
            flush=True,
        )
    summary = summarize(seeds)
    print(f"\n{markdown(summary)}\n\nwanted: {WANTED} on the unseen after learning on six")
    write_json(
        options.json,
        {**summary, "wanted": WANTED, "steps": options.steps, "overrides": options.overrides},
    )


if __name__ == "__main__":
    main()
