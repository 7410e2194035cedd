"""What `experiment=real_car` drives in the simulator and as the physical car, and what its ingredients bring.

    python -m benchmarks.real_car [--seeds 5] [--first-seed 1] [--tracks A,B] [--without car,...] [--jobs 1]
                                  [--frames DIR] [--runs-dir DIR] [--json FILE] [OVERRIDE...]

For each track and seed `deepracer-exp train experiment=real_car` trains as the experiment has it, and once more without
each of the ingredients of `--without`: without the `car`'s own picture,
timing and controls in the training (`randomization=sim2real`); without its `speeds`, with those of the default action
space; without its `off_road_cost` of five metres, with the usual two; without `sim2real` and the car. OVERRIDE goes to
all of them: `device=cuda collector=in_process` for a GPU. The recipe was chosen on the seeds 0 and 100, which are left
out by default.

The best checkpoint of each then drives single laps from TRIALS starts by which none was chosen, the most probable
actions: in the simulator, under `sim2real`, and as the physical car does (`evaluation=real_car`) with each of its parts
alone, with all, and with all under `sim2real` (`car_sim2real`).

JSON has in `trainings` a row for each track and ingredient left out (null: none). Its figures have a value for each
seed, null where there is none, with the interquartile mean over seeds and its 95% bootstrap interval:

- `steps`, `train_s`: of the whole training, its evaluations included;
- `laps_simulator`, `laps_sim2real`, `laps_picture`, `laps_timing`, `laps_controls`, `laps_car`, `laps_car_sim2real`:
  share of complete laps;
- `lap_s_simulator`, ...: mean time of these;
- `zigzag_simulator`, `zigzag_car`: changes of steering from side to side a metre of straight;
- with `--frames DIR`, pictures of 160x120 that AWS's simulator took: `openvino_same`, the share of them on which the
  archive for the car decides the same in OpenVINO, the car's converter, as the policy does here, and
  `openvino_difference`, the largest difference of a probability, or of steering or speed as a share of its range.

`--runs-dir DIR` leaves the runs in DIR and takes those that it finds finished there: an interrupted benchmark
continues.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from deepracer_exp.commands.export.car_check import CAR, SIMULATOR, car_protocols
from deepracer_exp.commands.export.car_converter import NEEDED, Conversion, compare_in_openvino, has_openvino
from deepracer_exp.commands.export.car_export import car_archive
from deepracer_exp.commands.export.onnx import DeployedPolicy
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.errors import BadInput
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.results import NOTHING, USUAL
from deepracer_exp.runs.stored_run import StoredRun

from .camera import read_frames
from .command import at_once, read_summary, trained
from .fresh import fresh_trials, stored_policy
from .report import (
    benchmark_parser,
    iqm_text,
    number,
    over_seeds,
    percent,
    table,
    with_exit_code,
    write_json,
)

TRACKS = ("reinvent_base", "reInvent2019_track")
WITHOUT: dict[str, list[str]] = {
    "car": ["randomization=sim2real"],
    "speeds": ["action_space=continuous"],
    "off_road_cost": ["reward=progress_delta"],
    "sim2real": ["randomization=none"],
}
"""Overrides that leave an ingredient out."""
SIM2REAL, CAR_SIM2REAL = "sim2real", "car_sim2real"
WANTED = {SIMULATOR: 0.95, SIM2REAL: 0.9, CAR: 0.9}
"""Shares of complete laps that are wanted within `WANTED_S` of training on two cores."""
WANTED_S = 3600.0
TRIALS = 20
_ALWAYS = ("tracking=off", "report=false")


def training_overrides(track: str, without: str | None, overrides: Sequence[str]) -> list[str]:
    """Return the overrides of `deepracer-exp train` of all seeds; `without` is a key of `WITHOUT`, or None."""
    left_out = [] if without is None else WITHOUT[without]
    return ["experiment=real_car", f"track={track}", *_ALWAYS, *left_out, *overrides]


def protocols() -> dict[str, EvaluationConfig]:
    """Return how a policy is driven, by name."""
    config = fresh_trials(TRIALS, "real_car")
    simulator, *parts = car_protocols(config).items()
    under_sim2real = (SIM2REAL, replace(simulator[1], usual=SIM2REAL))
    return dict(
        [simulator, under_sim2real, *parts, (CAR, config), (CAR_SIM2REAL, replace(config, usual=SIM2REAL))]
    )


def measure(run: Path, frames: Tensor | None) -> dict[str, float | None]:
    """Return the figures of a run; `frames` are pictures (n, 1, 120, 160), bytes, None: there are none."""
    torch.set_num_threads(1)
    summary = read_summary(run)
    experiment, policy = stored_policy(run)
    figures: dict[str, float | None] = {"steps": summary["env_steps"], "train_s": summary["wall_clock_s"]}
    for name, config in protocols().items():
        driven = Evaluator(experiment, config)(policy).on(USUAL)
        figures |= {f"laps_{name}": driven.lap_share, f"lap_s_{name}": driven.mean_lap_time_s}
        if name in (SIMULATOR, CAR):
            figures[f"zigzag_{name}"] = driven.zigzag.changes_per_m
    if frames is not None:
        converted = convert(run, frames)
        figures |= {"openvino_same": converted.same.mean(), "openvino_difference": converted.difference}
    return {name: None if value is None else round(float(value), 5) for name, value in figures.items()}


def convert(run: Path, frames: Tensor) -> Conversion:
    """Compare what OpenVINO decides on pictures with the run's best policy."""
    stored = StoredRun(run).with_checkpoint(None)
    networks, experiment = stored.read_policy().networks, stored.experiment
    policy = DeployedPolicy(networks, build_action_space(experiment.action_space)).eval()
    return compare_in_openvino(car_archive(networks, experiment), policy, [frames])


def benchmark(options: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Train what is not in `folder` yet, drive, and return a row for each track and ingredient left out."""
    frames = None
    if options.frames is not None:
        if not has_openvino():
            raise BadInput(f"--frames {options.frames}", "needs OpenVINO", NEEDED)
        frames = torch.from_numpy(np.rint(read_frames(options.frames)).astype(np.uint8))[:, None]
    asked = [
        (track, without, training_overrides(track, without, options.overrides))
        for track in options.tracks
        for without in (None, *options.without)
    ]
    # All of them before the first training: one that cannot be composed costs nothing.
    for _, _, words in asked:
        compose_experiment(words)
    calls = [
        partial(trained, folder / f"{track}-{without or 'whole'}-{seed}", [*words, f"seed={seed}"])
        for track, without, words in asked
        for seed in range(options.first_seed, options.first_seed + options.seeds)
    ]
    print(f"{len(calls)} runs of {len(asked)} groups, {options.jobs} at once", flush=True)
    runs = at_once(options.jobs, calls)
    rows = []
    for index, (track, without, _) in enumerate(asked):
        driven = [measure(run, frames) for run in runs[index * options.seeds : (index + 1) * options.seeds]]
        figures = {name: over_seeds([one[name] for one in driven]) for name in driven[0]}
        rows.append({"track": track, "without": without, **figures})
        print(table(HEAD, [_cells(rows[-1])]), flush=True)
    return rows


HEAD = (
    *(
        "track, without",
        "steps",
        "training (min)",
        "laps: simulator",
        SIM2REAL,
        "picture",
        "timing",
        "controls",
    ),
    *(
        "car",
        "car, sim2real",
        "lap (s): simulator",
        "car",
        "zig-zag /m: simulator",
        "car",
        "same in OpenVINO",
    ),
)


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    def minutes(value: float | None) -> str:
        return number(None if value is None else value / 60, 1)

    seconds = partial(number, digits=2)
    laps = [iqm_text(row[f"laps_{name}"], percent) for name in protocols()]
    return (
        f"{row['track']}, {row['without'] or 'nothing'}",
        iqm_text(row["steps"], number),
        iqm_text(row["train_s"], minutes),
        *laps,
        *(iqm_text(row[f"lap_s_{name}"], seconds) for name in (SIMULATOR, CAR)),
        *(iqm_text(row[f"zigzag_{name}"], seconds) for name in (SIMULATOR, CAR)),
        iqm_text(row["openvino_same"], percent) if "openvino_same" in row else NOTHING,
    )


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and store."""
    parser = benchmark_parser("real_car", __doc__)
    parser.add_argument("--seeds", type=int, default=5, help="trainings of each")
    parser.add_argument("--first-seed", type=int, default=1, help="the others follow it")
    parser.add_argument("--tracks", type=_names, default=TRACKS, help=f"default: {','.join(TRACKS)}")
    known = ",".join(WITHOUT)
    parser.add_argument("--without", type=_names, default=(), help=f"some of {known}")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at once")
    parser.add_argument(
        "--frames", type=Path, help="folder of pictures, 160x120, for the archive in OpenVINO"
    )
    parser.add_argument("--runs-dir", type=Path, help="folder of the runs; left out: they are not kept")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.without if name not in WITHOUT]
    if unknown:
        raise BadInput(f"--without {','.join(unknown)}", "no such ingredient", known)
    if options.seeds < 1 or options.jobs < 1:
        raise BadInput("--seeds and --jobs: accepted: 1 or more")
    with tempfile.TemporaryDirectory() as temporary:
        rows = benchmark(options, (options.runs_dir or Path(temporary)).resolve())
    print(f"\n{table(HEAD, list(map(_cells, rows)))}")
    wanted = ", ".join(f"{share:.0%} ({name})" for name, share in WANTED.items())
    print(f"\nwanted within {WANTED_S / 60:.0f} minutes on two cores: laps {wanted}")
    write_json(
        options.json,
        {"trainings": rows, "trials": TRIALS, "seeds": options.seeds, "overrides": options.overrides},
    )


def _names(text: str) -> list[str]:
    return [name for name in text.split(",") if name]


if __name__ == "__main__":
    sys.exit(main())
