"""`deepracer-exp tracks`: the list of tracks, a picture of one, and the fastest lap of a car on it."""

import argparse
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput, count, writing

from .arguments import add_command, add_overrides, is_override
from .exchange import picture_file
from .output import (
    is_compiled_first,
    plain_console,
    print_notes,
    table_console,
    warn_of_compiling,
)

if TYPE_CHECKING:
    import pandas as pd

    from deepracer_exp.config.experiment import Experiment
    from deepracer_exp.evaluation.fastest.fastest_lap import FastestLap
    from deepracer_exp.tracks.track import Track

_EPILOG = """\
  deepracer-exp tracks                                      all tracks, by family
  deepracer-exp tracks Oval_track -o oval.png --line line.py
  deepracer-exp tracks Oval_track --fastest -o fastest.png --line fastest.csv
  deepracer-exp tracks Oval_track --fastest car=deepracer_v5 action_space=continuous action_space.speed.high=4
"""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = add_command(
        commands,
        "tracks",
        _tracks,
        help="list the tracks, draw one, or find its fastest lap",
        description=(
            "List the tracks with length, width and variants; with a name, draw that track. With --fastest, find the "
            "fastest lap of a car within the limits of an action space. It is searched once and then kept."
        ),
        epilog=_EPILOG,
    )
    name = parser.add_argument(
        "name", nargs="?", metavar="TRACK", help="a track of the list, or a route file (.npy, .yaml)"
    )
    name.completer = _names  # type: ignore[attr-defined]
    add_overrides(parser, "car=NAME | action_space=NAME | KEY=VALUE")
    parser.add_argument(
        "-o", "--output", type=picture_file, metavar="FILE", help="also write a picture of it"
    )
    parser.add_argument(
        "--line", metavar="FILE", help="also write its racing line (.csv, .npy, or .py: a Python list)"
    )
    parser.add_argument(
        "--fastest",
        action="store_true",
        help="find the fastest lap of the car; picture and line are then those of the lap, with its speed",
    )


ROUTES = (".npy", ".yaml", ".yml")
"""Endings of files with a track."""
COLUMNS, ROWS = 100, 32
"""Largest size of a drawing, in characters and lines."""


def _names(**_: object) -> list[str]:
    from deepracer_exp.config.options import options

    return options("track")


def _tracks(args: argparse.Namespace) -> int:
    if args.name is not None and is_override(args.name):
        args.name, args.overrides = None, [args.name, *args.overrides]
    if words := [word for word in args.overrides if not is_override(word)]:
        raise BadInput(f"unrecognized arguments: {' '.join(words)}; see `deepracer-exp tracks --help`")
    if args.name is not None:
        _show_track(args)
    elif wanted := args.output or args.line or next(iter(args.overrides), None):
        raise BadInput(f"tracks: no track for {wanted}; accepted: tracks NAME")
    elif args.fastest:
        raise BadInput("tracks --fastest: no track; accepted: tracks NAME --fastest")
    else:
        _list_tracks()
    return 0


def _list_tracks() -> None:
    """Print a line for each family of worlds, then the user's own tracks."""
    from rich.table import Table

    from deepracer_exp.aws.worlds.catalogue import leaders, worlds
    from deepracer_exp.config.options import options
    from deepracer_exp.config.overrides import override_line

    out = table_console(160)
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("track", no_wrap=True)
    table.add_column("course", overflow="fold")
    for name in ("length (m)", "width (m)", "waypoints"):
        table.add_column(name, justify="right")
    table.add_column("variants", overflow="fold")
    for name in leaders():
        world = worlds()[name]
        others = [other for other in worlds().values() if other.family == world.family and other.name != name]
        length_m, width_m = _measures(name)
        table.add_row(
            name,
            world.title,
            f"{length_m:.2f}",
            f"{width_m:.2f}",
            str(world.rows),
            " ".join(other.name.replace(other.family, "…", 1) for other in others),
        )
    unusable = []
    for name in options("track"):
        if name not in worlds():
            try:
                _, track = experiment_on([override_line("track", name)])
            except BadInput as error:
                table.add_row(name, "unusable", "", "", "", "")
                unusable.append(f"{name}: {error}")
                continue
            measures = f"{track.length_m:.2f}", f"{track.width_m:.2f}", str(len(track.waypoints))
            table.add_row(name, track.title, *measures, "")
    out.print(table)
    for line in unusable:
        out.print(f"\n{line}", soft_wrap=True, markup=False)
    out.print(
        f"\ntrack=NAME accepts each of {len(options('track'))} tracks, also variants and official names "
        "(track='Ace Speedway').\n`deepracer-exp tracks NAME` draws one.",
        soft_wrap=True,
    )


def _show_track(args: argparse.Namespace) -> None:
    """Draw a track, or a route file (.npy, .yaml), in the terminal; write the requested files."""
    from deepracer_exp.config.overrides import override_line
    from deepracer_exp.reports.tables.line_file import check_line_file, racing_line_table, write_line
    from deepracer_exp.tracks.drawing import draw_picture, draw_terminal

    is_file = Path(args.name).suffix in ROUTES
    check_line_file(args.line)
    experiment, track = experiment_on(
        [override_line("track.file" if is_file else "track", args.name), *args.overrides]
    )
    lap = search_fastest(experiment, track) if args.fastest else None
    if args.output is not None:
        driven = None if lap is None else _line_table(lap)[["x_m", "y_m", "speed_mps"]].to_numpy()
        with writing(f"--output {args.output}", "", BadInput, ValueError):  # an unknown ending
            draw_picture(track, args.output, driven)
    if args.line is not None:
        with writing(f"--line {args.line}"):
            write_line(Path(args.line), racing_line_table(track) if lap is None else _line_table(lap))
    wide, high = shutil.get_terminal_size((COLUMNS, ROWS))
    print(
        f"{track.title} ({track.name}): {track.length_m:.2f} m, {track.width_m:.2f} m wide, "
        f"{len(track.waypoints)} waypoints\n"
    )
    print(draw_terminal(track, columns=min(wide, COLUMNS), rows=max(12, min(high - 6, ROWS))))
    if lap is not None:
        _print_lap(lap, experiment)
    for what, path in (("picture", args.output), ("racing line" if lap is None else "its line", args.line)):
        if path is not None:
            print(f"\n{what}: {path}")


def experiment_on(overrides: list[str]) -> "tuple[Experiment, Track]":
    """Return an experiment on one track, and that track in the direction of its first episode."""
    from deepracer_exp.config.compose import compose_experiment
    from deepracer_exp.tracks.track import Track

    experiment, composition = compose_experiment(overrides)
    print_notes(composition.notes)
    if len(experiment.tracks) > 1:
        raise BadInput(f"{overrides[0]}: {len(experiment.tracks)} tracks; accepted: one to draw")
    (config,) = experiment.tracks.values()
    return experiment, Track.from_config(config)


def search_fastest(experiment: "Experiment", track: "Track") -> "FastestLap":
    """Return the fastest lap; a search prints its subject and progress on standard error.

    Raises:
        BadInput: as for `Question.of`.
        RunFailed: no lap is possible within the limits.
    """
    from rich.progress import Progress, TimeRemainingColumn

    from deepracer_exp.evaluation.fastest.fastest_lap import Question, fastest_lap, kept_lap
    from deepracer_exp.evaluation.fastest.lap_search import PASSES

    question = Question.of(experiment, track)
    kept = kept_lap(question)
    if kept is not None:
        return kept
    console, rounds = plain_console(stderr=True), count(len(PASSES), "round")
    warn_of_compiling()
    if is_compiled_first("optimal_control"):
        rounds += "; the search is compiled first, once after an installation (about a minute)"
    console.print(
        f"searching the fastest lap of {experiment.car.name} on {track.title} in {rounds}", soft_wrap=True
    )
    columns = (*Progress.get_default_columns()[:3], TimeRemainingColumn())
    shown = 0
    # Without a terminal there is no bar, and each tenth is a line.
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("fastest lap", total=1.0)

        def show(share: float, lap_time_s: float | None) -> None:
            nonlocal shown
            so_far = "no lap yet" if lap_time_s is None else f"{lap_time_s:.3f} s so far"
            progress.update(task, completed=share, description=f"fastest lap, {so_far}")
            if not console.is_terminal and int(10 * share) > shown:
                shown = int(10 * share)
                console.print(f"  {share:.0%}: {so_far}")

        return fastest_lap(question, show)


def _print_lap(lap: "FastestLap", experiment: "Experiment") -> None:
    from deepracer_exp.evaluation.fastest.fastest_lap import command_limits

    speed, (low, high) = lap.column("speed_mps"), command_limits(experiment)
    print(
        f"\nfastest lap of {experiment.car.name}: {lap.lap_time_s:.3f} s by the service's clock, from standstill at "
        f"the start line\n  mean speed {speed.mean():.2f} m/s, highest {speed.max():.2f} m/s\n"
        f"  commands between {low[0]:g} and {high[0]:g} degrees, {low[1]:g} and {high[1]:g} m/s\n"
        f"  bound from below: {lap.bound_s:.3f} s; the lap is {100 * lap.over_bound:.1f}% above it"
    )


def _line_table(lap: "FastestLap") -> "pd.DataFrame":
    """Return a lap as a table of points."""
    import pandas as pd

    return pd.DataFrame({name: lap.column(name) for name in ("x_m", "y_m", "speed_mps", "progress")})


def _measures(name: str) -> tuple[float, float]:
    """Return a world's length and median width in metres."""
    import numpy as np

    from deepracer_exp.aws.worlds.routes import world_rows

    center, inner, outer = np.split(world_rows(name), 3, axis=1)
    length_m = np.linalg.norm(np.diff(center, axis=0), axis=1).sum()
    return float(length_m), float(np.median(np.linalg.norm(outer - inner, axis=1)))
