"""`deepracer-exp tracks`: the list of tracks, and a drawing of one."""

import argparse
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput

from .arguments import add_command
from .output import table_console

if TYPE_CHECKING:
    from deepracer_exp.deepracer.worlds import World
    from deepracer_exp.tracks.track import Track

COLUMNS, ROWS = 100, 32
"""Largest size of a drawing, in characters and lines."""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = add_command(
        commands,
        "tracks",
        _tracks,
        help="list the tracks, or draw one",
        description="List the tracks with length, width and variants; with a name, draw that track.",
    )
    name = parser.add_argument("name", nargs="?", help="a track of the list, or a route file (.npy, .yaml)")
    name.completer = _names  # type: ignore[attr-defined]
    parser.add_argument("-o", "--output", metavar="FILE", help="also write a picture of it")


def _names(**_: object) -> list[str]:
    from deepracer_exp.config.options import options

    return options("track")


def _tracks(args: argparse.Namespace) -> int:
    if args.name is None:
        _list_tracks()
    else:
        _show_track(args.name, args.output)
    return 0


def _list_tracks() -> None:
    """Print a line for each family of worlds, then the user's own tracks."""
    from rich.table import Table

    from deepracer_exp.config.options import options
    from deepracer_exp.config.overrides import override_line
    from deepracer_exp.deepracer.worlds import leaders, worlds

    out = table_console(160)
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("track", no_wrap=True)
    table.add_column("course", overflow="fold")
    for name in ("length (m)", "width (m)", "waypoints"):
        table.add_column(name, justify="right")
    table.add_column("variants", overflow="fold")
    for name in leaders():
        world = worlds()[name]
        others = [one for one in worlds().values() if one.family == world.family and one.name != name]
        length_m, width_m = _measures(name)
        table.add_row(
            name,
            world.title,
            f"{length_m:.2f}",
            f"{width_m:.2f}",
            str(world.rows),
            " ".join(map(_variant, others)),
        )
    for name in options("track"):
        if name not in worlds():
            track = _track(override_line("track", name))
            measures = f"{track.length_m:.2f}", f"{track.width_m:.2f}", str(len(track.waypoints))
            table.add_row(name, track.title, *measures, "")
    out.print(table)
    out.print(
        f"\ntrack=NAME accepts each of {len(options('track'))} tracks, also variants and official names "
        "(track='Ace Speedway').\n`deepracer-exp tracks NAME` draws one.",
        soft_wrap=True,
    )


def _show_track(name: str, output: str | None) -> None:
    """Draw a track in the terminal, and as a picture where one is asked for.

    Args:
        name: of a track, or a route file (.npy, .yaml).
        output: the picture to write; its ending chooses the format.

    Raises:
        BadInput: there is no such track, or the picture cannot be written.
    """
    from deepracer_exp.config.overrides import override_line
    from deepracer_exp.tracks.drawing import draw_picture, draw_terminal

    is_file = Path(name).suffix in (".npy", ".yaml", ".yml")
    track = _track(override_line("track.file" if is_file else "track", name))
    if output is not None:
        try:
            draw_picture(track, output)
        except (OSError, ValueError) as error:
            raise BadInput(f"--output {output}: cannot be written: {error}") from error
    wide, high = shutil.get_terminal_size((COLUMNS, ROWS))
    print(
        f"{track.title} ({track.name}): {track.length_m:.2f} m, {track.width_m:.2f} m wide, "
        f"{len(track.waypoints)} waypoints\n"
    )
    print(draw_terminal(track, columns=min(wide, COLUMNS), rows=max(12, min(high - 6, ROWS))))
    if output is not None:
        print(f"\npicture: {output}")


def _track(override: str) -> "Track":
    from deepracer_exp.config.compose import compose_experiment
    from deepracer_exp.tracks.track import Track

    tracks = compose_experiment([override])[0].tracks
    if len(tracks) > 1:
        raise BadInput(f"{override}: {len(tracks)} tracks; accepted: one to draw")
    (config,) = tracks.values()
    return Track.from_config(config)


def _measures(name: str) -> tuple[float, float]:
    """Return a world's length and median width in metres."""
    import numpy as np

    from deepracer_exp.deepracer.routes import world_rows

    center, inner, outer = np.split(world_rows(name), 3, axis=1)
    length_m = np.linalg.norm(np.diff(center, axis=0), axis=1).sum()
    return float(length_m), float(np.median(np.linalg.norm(outer - inner, axis=1)))


def _variant(world: "World") -> str:
    return world.name.replace(world.family, "…", 1)
