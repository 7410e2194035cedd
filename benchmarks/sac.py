"""PPO and SAC side by side, and Stable-Baselines3's SAC on the same cars, each for the same number of seconds.

    python -m benchmarks.sac [--seeds 5] [--minutes 2] [--tracks A,B,...] [--actions continuous,discrete_fast]
                             [--jobs 2] [--runs-dir DIR] [--json FILE] [OVERRIDE...]

For each seed, track and list of actions, `deepracer-exp train` runs with `algorithm=ppo` and with `algorithm=sac`, all
cars in one process and one thread, until its minutes are over; with continuous actions (it has no SAC for others)
`benchmarks.sb3_timed` follows, with the hyperparameters of `algorithm=sac`. Trainings that are compared begin one after
the other, `--jobs` of them at once, so that what else the machine does is about the same for them.

JSON has in `rows` one for each track, actions and algorithm (`ppo`, `sac`, `sb3_sac`). Its figures have a value for
each seed, null where there is none, with the interquartile mean over seeds and its 95% bootstrap interval, where null
is longer than any:

- `reliable_steps`, `reliable_s`: until 90% of the last 50 training episodes were complete laps; seconds count from the
  first control step and include evaluations and checkpoints, of which Stable-Baselines3 makes none;
- `steps`, `train_s`: of the whole training; `steps_per_s`;
- `lap_time_s`, `lap_share`: mean time and share of the complete ones of 64 fresh laps on usual conditions, driven by
  the best checkpoint, of Stable-Baselines3 by its last policy.

`--runs-dir DIR` leaves the runs in DIR and takes those that it finds finished there: an interrupted benchmark
continues.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.files import atomic_write

from .command import at_once, read_metrics, run_benchmark, trained
from .fresh import drive
from .report import benchmark_parser, iqm_text, number, over_seeds, percent, table, with_exit_code, write_json

TRACKS = ("reinvent_base", "reInvent2019_track", "Spain_track")
ACTIONS = ("continuous", "discrete_fast")
PEER = "sb3_sac"
LAP_SHARE = 0.9
FIGURES = ("reliable_steps", "reliable_s", "steps", "train_s", "steps_per_s", "lap_time_s", "lap_share")
_ALWAYS = (
    *("stopping=none", "budget.env_steps=null", "checkpoints.metric=reliable_lap"),
    *("collector=in_process", "collector.threads=1", "tracking=off", "report=false"),
)


class Asked(NamedTuple):
    """What is trained, but for the seed."""

    track: str
    actions: str
    """Option of conf/action_space."""
    algorithm: str
    """Option of conf/algorithm, with the prefix `sb3_` that of Stable-Baselines3."""

    def overrides(self, minutes: float, own: Sequence[str]) -> list[str]:
        """Return the overrides of `deepracer-exp train`."""
        algorithm = f"algorithm={self.algorithm.removeprefix('sb3_')}"
        return [
            *(f"track={self.track}", f"action_space={self.actions}", algorithm),
            *(*_ALWAYS, f"budget.minutes={minutes:g}", *own),
        ]


def measure(run: Path, checkpoint: str | None = None) -> dict[str, float | None]:
    """Return the figures of a run; its laps are those of a checkpoint, None: the best."""
    rows = read_metrics(run)
    reliable = next((row for row in rows if (row["lap_share"] or 0.0) >= LAP_SHARE), {})
    (driven,) = drive(run, [checkpoint])
    return {
        "reliable_steps": reliable.get("env_steps"),
        "reliable_s": reliable.get("wall_clock_s"),
        "steps": rows[-1]["env_steps"],
        "train_s": rows[-1]["wall_clock_s"],
        **driven.figures(),
    }


def ours(folder: Path, overrides: Sequence[str]) -> dict[str, float | None]:
    """Train with `deepracer-exp` unless a finished run is in `folder`, and return its figures."""
    return measure(trained(folder, overrides))


def peer(folder: Path, overrides: Sequence[str], minutes: float) -> dict[str, float | None]:
    """Train with Stable-Baselines3 in a process of its own, unless its figures are in `folder`, and return them.

    Raises:
        SystemExit: the process failed; the message is its own.
    """
    file = folder / f"{PEER}.json"
    asked = {"overrides": list(overrides), "minutes": minutes}
    if file.exists():
        stored = json.loads(file.read_text(encoding="utf-8"))
        if stored["asked"] == asked:
            return dict(stored["figures"])
    figures = run_benchmark("sb3_timed", "--seconds", f"{60 * minutes:g}", *overrides)
    folder.mkdir(parents=True, exist_ok=True)
    atomic_write(file, json.dumps({"asked": asked, "figures": figures}) + "\n")
    print(f"{folder.name}: trained", flush=True)
    return figures


def benchmark(options: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Train what is not in `folder` yet, and return a row for each track, actions and algorithm."""
    groups = [
        Asked(track, actions, algorithm)
        for track in options.tracks.split(",")
        for actions in options.actions.split(",")
        for algorithm in ("ppo", "sac", *[PEER] * (actions == "continuous"))
    ]
    words = {asked: asked.overrides(options.minutes, options.overrides) for asked in groups}
    # All of them before the first training: one that cannot be composed costs nothing.
    for overrides in words.values():
        compose_experiment(overrides)
    calls: list[Callable[[], dict[str, float | None]]] = []
    for seed in range(options.seeds):
        for asked in groups:
            place, of_seed = folder / "-".join([*asked, str(seed)]), [*words[asked], f"seed={seed}"]
            is_peer = asked.algorithm == PEER
            calls.append(
                partial(peer, place, of_seed, options.minutes) if is_peer else partial(ours, place, of_seed)
            )
    print(f"{len(calls)} runs of {len(groups)} groups, {options.jobs} at once", flush=True)
    found = at_once(options.jobs, calls)
    for figures in found:
        steps, train_s = figures["steps"], figures["train_s"]
        assert steps is not None
        assert train_s is not None
        figures["steps_per_s"] = round(steps / train_s, 1)
    rows = []
    for index, asked in enumerate(groups):
        of_group = found[index :: len(groups)]
        rows.append(asked._asdict() | {name: over_seeds([one[name] for one in of_group]) for name in FIGURES})
    return rows


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of tracks, actions and algorithms."""
    head = (
        *("track, actions, algorithm", "90% of laps (steps)", "90% of laps (s)", "steps/s"),
        *("steps", "lap (s)", "complete"),
    )

    def cell(figure: dict[str, Any], digits: int) -> str:
        return iqm_text(figure, partial(number, digits=digits))

    return table(
        head,
        [
            (
                f"{row['track']}, {row['actions']}, {row['algorithm']}",
                cell(row["reliable_steps"], 0),
                cell(row["reliable_s"], 1),
                cell(row["steps_per_s"], 0),
                cell(row["steps"], 0),
                cell(row["lap_time_s"], 2),
                iqm_text(row["lap_share"], percent),
            )
            for row in rows
        ],
    )


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and store."""
    parser = benchmark_parser("sac", __doc__)
    parser.add_argument("--seeds", type=int, default=5, help="trainings of each, with the seeds 0, 1, ...")
    parser.add_argument("--minutes", type=float, default=2.0, help="of each training")
    parser.add_argument("--tracks", default=",".join(TRACKS), help="options of the group track")
    parser.add_argument("--actions", default=",".join(ACTIONS), help="options of the group action_space")
    parser.add_argument("--jobs", type=int, default=2, help="trainings at once")
    parser.add_argument("--runs-dir", type=Path, help="folder of the runs; left out: they are not kept")
    options = parser.parse_args(arguments)
    if options.seeds < 1 or options.jobs < 1:
        raise BadInput("--seeds and --jobs: accepted: 1 or more")
    if options.minutes <= 0:
        raise BadInput(f"--minutes {options.minutes:g}", "no time to train", "more than 0")
    with tempfile.TemporaryDirectory() as temporary:
        rows = benchmark(options, (options.runs_dir or Path(temporary)).resolve())
    print(f"\n{markdown(rows)}")
    given = {"seeds": options.seeds, "minutes": options.minutes, "overrides": options.overrides}
    write_json(options.json, {"rows": rows, **given})


if __name__ == "__main__":
    sys.exit(main())
