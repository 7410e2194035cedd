"""Recompute the crashes of recordings with boxes and bots from the poses of the car.

    python -m benchmarks.others --traces DIR [--json FILE]

No trace says where the others were, so `RACES` has the settings of each recording by the name of its file.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.others.race_others import RaceOthers
from deepracer_exp.env.rules import RaceRules
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.env.trace_columns import STATUS_CODE
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.source import NO_REWARD
from deepracer_exp.sim.batch import CarState

from .report import benchmark_parser, number, table, with_exit_code, write_json

RACES = {
    "console_v5_one_bot_ppo.tar.gz": (
        "track=2022_reinvent_champ_ccw",
        "race=head_to_bot",
        "race.bots.number=1",
        "race.bots.speed_mps=0.5",
        "race.bots.lane_change_after_s=null",
        "observation.next_objects=1",
        "episode.max_steps=0",
    )
}
"""Track and others of recordings, as overrides."""


def measure(path: Path, setup: RaceSetup) -> dict[str, Any]:
    """Judge every recorded pose, all episodes side by side, and compare with the recorded crashes.

    A row of the trace has the clock at its end and the pose at its beginning, and bots are sent with the clock of the
    row before (deepracer-simapp, environments/deepracer_racetrack_env.py).
    """
    rows = read_recording(path).steps
    rows["car"] = rows.groupby(["stream", "episode"], sort=False, observed=True).ngroup()
    rows = rows.sort_values(["car", "steps"], kind="stable", ignore_index=True)
    car, step = rows["car"].to_numpy(), rows["steps"].to_numpy(np.int64) - 1
    n_cars, n_steps = int(car.max()) + 1, int(step.max()) + 1
    front_m, period_s = setup.car.front_point_m, setup.car.control_period_s
    yaw_rad = np.radians(rows["yaw"].to_numpy())
    recorded = np.array(
        [
            rows["X"] - front_m * np.cos(yaw_rad),
            rows["Y"] - front_m * np.sin(yaw_rad),
            yaw_rad,
            rows["tstamp"],
        ]
    )
    # A car whose episode is over waits where it ended.
    poses = np.repeat(recorded[:, rows.groupby("car")["steps"].idxmax()][:, None], n_steps, axis=1)
    poses[:, step, car] = recorded
    first = rows.groupby("car").first()
    begun = setup.track.project(first[["X", "Y"]].to_numpy()).ndist - first["progress"].to_numpy() / 100
    begun_s = first["tstamp"].to_numpy() - period_s
    rules = RaceRules(setup, n_cars)
    assert setup.others is not None
    others = RaceOthers(setup.others, setup, rules)
    others.seed(0)
    others.begin(np.arange(n_cars), rules.reset(start_ndist=begun % 1), evaluated=True)
    crashed = np.zeros((n_steps, n_cars), bool)
    for at in range(n_steps):
        rules.measure(CarState(*poses[:3, at], *np.zeros((4, n_cars))))
        result, _ = others.judge(rules.apply(), poses[3, max(at - 1, 0)] - begun_s)
        crashed[at] = result.status == STATUS_CODE["crashed"]
    was = (rows["episode_status"] == "crashed").to_numpy()
    found = crashed[step, car]
    wrong = rows[was != found]
    return {
        "recording": path.name,
        "rows": len(rows),
        "wrong_rows": len(wrong),
        "crashes": int(was.sum()),
        "crashes_found": int((was & found).sum()),
        "mismatches": _mismatches(wrong, found[was != found]),
    }


def _mismatches(wrong: pd.DataFrame, found: np.ndarray) -> list[dict[str, Any]]:
    columns = ("iteration", "episode", "steps")
    return [
        {
            **{name: int(row[name]) for name in columns},
            "recorded": row["episode_status"],
            "crashed": bool(here),
        }
        for (_, row), here in zip(wrong.iterrows(), found, strict=True)
    ]


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and store."""
    parser = benchmark_parser("others", __doc__, None)
    parser.add_argument("--traces", required=True, type=Path, help="folder of the recordings")
    options = parser.parse_args(arguments)
    paths = [path for name in RACES for path in sorted(options.traces.rglob(name))]
    if not paths:
        raise BadInput(
            f"--traces {options.traces}", "no recording with others", f"a folder with {', '.join(RACES)}"
        )
    results = []
    for path in paths:
        setup = build_setup(compose_experiment(RACES[path.name])[0], reward=NO_REWARD)
        results.append(measure(path, setup))
    print(
        table(
            ("recording", "rows", "wrong", "of 1,000", "crashes", "found"),
            [
                (
                    one["recording"],
                    f"{one['rows']:,}",
                    str(one["wrong_rows"]),
                    number(1000 * one["wrong_rows"] / one["rows"], 2),
                    str(one["crashes"]),
                    str(one["crashes_found"]),
                )
                for one in results
            ],
        )
    )
    for one in results:
        for row in one["mismatches"]:
            print("  " + ", ".join(f"{key} {value}" for key, value in row.items()))
    totals = {
        key: sum(one[key] for one in results) for key in ("rows", "wrong_rows", "crashes", "crashes_found")
    }
    write_json(options.json, {**totals, "recordings": results})


if __name__ == "__main__":
    sys.exit(main())
