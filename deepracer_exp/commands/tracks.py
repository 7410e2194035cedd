"""`deepracer-exp tracks`: the courses there are, and one of them drawn."""

import shutil
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.options import options
from deepracer_exp.config.overrides import override_line
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.routes import world_rows
from deepracer_exp.formats.worlds import World, leaders, worlds
from deepracer_exp.tracks.drawing import draw_picture, draw_terminal
from deepracer_exp.tracks.track import Track

COLUMNS, ROWS = 100, 32
"""Characters and lines of a drawing at most."""


def list_tracks(out: Console) -> None:
    """Print a line for each family of worlds, then the tracks of one's own."""
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
    out.print(table, highlight=False)
    out.print(
        f"\ntrack=NAME takes each of {len(options('track'))} tracks, variants and official names too "
        "(track='Ace Speedway').\n`deepracer-exp tracks NAME` draws one.",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )


def show_track(name: str, output: str | None) -> None:
    """Draw a track in the terminal, and as a picture where one is asked for.

    Args:
        name: of a track, or a route file (.npy, .yaml).
        output: the picture to write; its ending chooses the format.

    Raises:
        BadInput: there is no such track, or the picture cannot be written.
    """
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


def _track(override: str) -> Track:
    tracks = compose_experiment([override])[0].tracks
    if len(tracks) > 1:
        raise BadInput(f"{override}: {len(tracks)} tracks; accepted: one to draw")
    (config,) = tracks.values()
    return Track.from_config(config)


def _measures(name: str) -> tuple[float, float]:
    """Return a world's length and median width in metres."""
    center, inner, outer = np.split(world_rows(name), 3, axis=1)
    length_m = np.linalg.norm(np.diff(center, axis=0), axis=1).sum()
    return float(length_m), float(np.median(np.linalg.norm(outer - inner, axis=1)))


def _variant(world: World) -> str:
    return world.name.replace(world.family, "…", 1)
