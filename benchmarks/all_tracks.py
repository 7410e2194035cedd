"""What a default training needs on eighteen tracks of the catalogue.

    python -m benchmarks.all_tracks [--jobs 1] [--markdown] [--json FILE] [TRACK...] [OVERRIDE...]

For each track, `deepracer-exp train track=TRACK` runs as a process of its own in an empty folder until 90 per cent of
the last 50 training episodes completed the lap, or until the budget's end. Read from its summary.json: control steps
over all cars and wall seconds since the start of the process until then (null where the budget ended the run), the
share of laps among the last 50 episodes, and the fastest exploring lap of the whole training, in simulated seconds.

Seconds are meaningful only with one job; several share the cores.
"""

import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.setup import build_courses
from deepracer_exp.errors import BadInput
from deepracer_exp.tracks.track import Track

from .command import read_summary, train
from .report import benchmark_parser, number, table, write_json

TRACKS = (
    "2022_summit_speedway",
    "AWS_track",
    "Bowtie_track",
    "Canada_Training",
    "Monaco",
    "Oval_track",
    "Spain_track",
    "Straight_track",
    "Tokyo_Training_track",
    "Vegas_track",
    "Virtual_May19_Train_track",
    "caecer_loop",
    "reInvent2019_track",
    "reInvent2019_wide",
    "reinvent_base",
    "reinvent_carpet",
    "reinvent_concrete",
    "reinvent_wood",
)
"""Of all kinds: 6 to 69 m long, 0.6 to 1.4 m wide, on several floors."""


def measure(option: str, track: Track, overrides: Sequence[str]) -> dict[str, Any]:
    """Train on one track."""
    with tempfile.TemporaryDirectory() as folder:
        summary = read_summary(train([f"track={option}", "stopping=reliable", *overrides], Path(folder)))
    reliable = summary["reliable"] or {}
    return {
        "track": option,
        "title": track.title,
        "length_m": round(track.length_m, 2),
        "reliable_steps": reliable.get("env_steps"),
        "reliable_s": reliable.get("since_process_start_s"),
        "best_lap_time_s": summary["best_lap_time_s"],
        "lap_share": summary["lap_share"],
        "laps": summary["laps"],
        "env_steps": summary["env_steps"],
    }


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table."""
    head = ("track", "name", "length (m)", "steps to 90%", "seconds to 90%", "fastest exploring lap (s)")
    lines = []
    for row in rows:
        unreached = f"not in {row['env_steps']:,} ({row['lap_share'] or 0.0:.0%})"
        steps = number(row["reliable_steps"]) if row["reliable_steps"] is not None else unreached
        lap_s = number(row["best_lap_time_s"], 2)
        course = f"`{row['track']}`", row["title"], number(row["length_m"], 2)
        lines.append((*course, steps, number(row["reliable_s"]), lap_s))
    return table(head, lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("all_tracks", __doc__, None)
    parser.add_argument("--jobs", type=int, default=1, help="trainings at the same time")
    parser.add_argument("--markdown", action="store_true", help="print nothing but the table")
    parser.add_argument(
        "chosen",
        nargs="*",
        metavar="TRACK | OVERRIDE",
        help="tracks (default: those eighteen), and KEY=VALUE for train",
    )
    args = parser.parse_args(arguments)
    overrides = [word for word in args.chosen if "=" in word]
    names = [word for word in args.chosen if "=" not in word] or TRACKS

    try:  # all of them before the first training; Hydra is not for several threads
        composed = [compose_experiment([f"track={name}", *overrides])[0] for name in names]
        tracks = [build_courses(experiment)[0].tracks[0] for experiment in composed]
    except BadInput as error:
        parser.error(str(error))

    def one(name: str, track: Track) -> dict[str, Any]:
        row = measure(name, track, overrides)
        if not args.markdown:
            print(f"{name}: {row}", flush=True)
        return row

    with ThreadPoolExecutor(args.jobs) as pool:
        rows = list(pool.map(one, names, tracks))
    print(markdown(rows))
    write_json(args.json, {"tracks": rows, "jobs": args.jobs, "overrides": overrides})


if __name__ == "__main__":
    main()
