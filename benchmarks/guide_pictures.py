"""The pictures of README.md and the guides: figures, pages and films that the program makes of short trainings.

    python -m benchmarks.guide_pictures [--runs-dir DIR] [--output DIR] [NAME...]

NAME are some of `PICTURES`, without any all of them; about a quarter of an hour on two cores. `--runs-dir` keeps the
runs, and takes those that it finds finished there. Pages are drawn by Chromium.
"""

import argparse
import io
import json
import os
import pty
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path

from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image
from rich.console import Console
from rich.text import Text

from deepracer_exp.errors import BadInput
from tests.browser import Tab, browser

from .command import command_line, trained
from .report import with_exit_code

OUTPUT = Path(__file__).parents[1] / "docs" / "images"
WIDTH, SCREEN = 1120, 640
"""Width of the browser window, and height of a first screen, px."""
TALLEST = 2400
"""Height of the browser window, px."""
COLUMNS = 100
"""Width of the terminal."""
_REDRAWN = re.compile(r"(?:\r|\x1b\[2K|\x1b\[1A)+\x1b\[2K")
TRACK = "reInvent2019_track"
SWEEP = ("sweep=lr_entropy", "sweep.trials=24", "study=pictures")


class Studio:
    """The runs, and the browser that shows their pages."""

    def __init__(self, folder: Path, tab: Tab) -> None:
        self.folder = folder.resolve()
        self._tab = tab

    def train(self, name: str, *overrides: str) -> Path:
        """Return the finished run of these overrides."""
        return trained(self.folder, [f"name={name}", *overrides])

    @cached_property
    def season(self) -> Path:
        """A training of the default experiment."""
        return self.train("season")

    def program(self, *words: str) -> None:
        """Run `deepracer-exp`.

        Raises:
            SystemExit: it did not end with exit code 0; the message is its own.
        """
        line = command_line(*words)
        done = subprocess.run(line, cwd=self.folder, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise SystemExit(f"{' '.join(line)}: exit code {done.returncode}\n{done.stderr}")

    def shot(self, page: Path, selector: str, width: int = WIDTH) -> Image.Image:
        """Return an element of a page."""
        self._tab.open(page, width, TALLEST)
        self._tab.draw_all()
        # Until all are drawn, those above move the ones below.
        self._tab.wait_for(
            "[...document.querySelectorAll('[data-plot]')].every((box) => box.querySelector('svg'))"
        )
        # Alone, it fits the window: a screenshot beyond it would change the layout.
        self._tab.evaluate(f"document.body.replaceChildren(document.querySelector({json.dumps(selector)}))")
        return Image.open(self._tab.picture(self.folder / "shot.png", selector)).convert("RGB")

    def figure(self, page: Path, name: str) -> Image.Image:
        """Return a figure of a page."""
        return self.shot(page, f'[data-plot="{name}"]')

    def frame(self, film: Path, at_s: float) -> Image.Image:
        """Return a frame of a film."""
        line = [get_ffmpeg_exe(), "-v", "error", "-ss", f"{at_s:g}", "-i", str(film)]
        png = subprocess.run([*line, "-frames:v", "1", "-f", "apng", "-"], capture_output=True, check=True)
        return Image.open(io.BytesIO(png.stdout)).convert("RGB")


def lap(studio: Studio) -> bytes:
    """Return the film of a lap, of README.md."""
    run = studio.train("fast", "experiment=fast_lap")
    film, small = studio.folder / "lap.mp4", studio.folder / "lap.webp"
    studio.program("evaluate", str(run), "evaluation.held_out=null", "--video", str(film))
    smaller = ("-vf", "scale=720:-2", "-r", "15", "-loop", "0", "-quality", "55")
    subprocess.run([get_ffmpeg_exe(), "-v", "error", "-y", "-i", str(film), *smaller, str(small)], check=True)
    return small.read_bytes()


def terminal(studio: Studio) -> Image.Image:
    """Return what a terminal shows in the middle of a training."""
    master, slave = pty.openpty()
    seen = {**os.environ, "COLUMNS": str(COLUMNS), "LINES": "30", "TERM": "xterm-256color"}
    line = command_line("train", "name=terminal")
    with subprocess.Popen(line, cwd=studio.folder, env=seen, stdout=slave, stderr=slave):
        os.close(slave)
        written = b"".join(iter(partial(_read, master), b""))
    os.close(master)
    text = written.decode().replace("\r\n", "\n")
    views = [view for view in _REDRAWN.split(text) if "usual lap" in view]
    console = Console(record=True, width=COLUMNS, file=io.StringIO(), color_system="truecolor")
    console.print(Text.from_ansi(views[len(views) // 2]))
    drawn = studio.folder / "terminal.html"
    svg = console.export_svg(title="deepracer-exp train")
    drawn.write_text(f'<meta charset="utf-8"><body style="margin: 0">{svg}', encoding="utf-8")
    return studio.shot(drawn, "svg")


def _read(master: int) -> bytes:
    try:
        return os.read(master, 1 << 16)
    except OSError:  # Linux says so when the program has ended.
        return b""


def reward_map(studio: Studio) -> Image.Image:
    """Return what a reward function rewards."""
    picture = studio.folder / "reward_map.png"
    studio.program("validate", "reward=racing_line", "-o", str(picture))
    return Image.open(picture).convert("RGB")


def watch(studio: Studio) -> Image.Image:
    """Return a frame of a film of a policy that sees pictures."""
    run = studio.train("camera", "observation=camera_small", "budget.env_steps=300000")
    film = studio.folder / "camera.mp4"
    studio.program("watch", str(run), "-o", str(film))
    return studio.frame(film, 2.0)


def tutorial(studio: Studio) -> Image.Image:
    """Return the first screen of a report."""
    card = studio.shot(studio.season / "report.html", "#outcome", 1700)
    return card.crop((0, 0, card.width, min(card.height, SCREEN)))


def of_report(name: str) -> Callable[[Studio], Image.Image]:
    """Return what takes a figure from a report."""
    return lambda studio: studio.figure(studio.season / "report.html", name)


def best_checkpoint(studio: Studio) -> Image.Image:
    """Return the checkpoints of a run, raced."""
    page = studio.folder / "checkpoints.html"
    studio.program("checkpoints", str(studio.season), "-o", str(page))
    return studio.figure(page, "speed_and_stability")


def faster_laps(studio: Studio) -> Image.Image:
    """Return what a lap loses to the fastest one."""
    page = studio.folder / "fastest.html"
    studio.program("analyze", str(studio.season), "--fastest", "-o", str(page))
    return studio.figure(page, "against_fastest")


def lineage(studio: Studio) -> Image.Image:
    """Return a family of clones."""
    for name, parent in (("second", "best:season"), ("third", "best:second")):
        if not list(studio.folder.glob(f"runs/{name}/*/summary.json")):
            studio.program("clone", parent, f"name={name}", "budget.env_steps=300000")
    page = studio.folder / "family.html"
    studio.program("compare", str(studio.season), "best:second", "best:third", "-o", str(page))
    return studio.figure(page, "generations")


def compare(studio: Studio) -> Image.Image:
    """Return the learning curves of two experiments."""
    page = studio.folder / "comparison.html"
    for seed in range(5):
        for name in ("mlp_small", "mlp"):
            studio.train(f"{name}_network", f"network={name}", "budget.env_steps=300000", f"seed={seed}")
    studio.program("compare", "mlp_small_network", "mlp_network", "-o", str(page))
    return studio.figure(page, "learning_curves")


def tracks(studio: Studio) -> Image.Image:
    """Return the fastest lap of a track."""
    picture = studio.folder / "fastest.png"
    studio.program("tracks", TRACK, "--fastest", "-o", str(picture))
    return Image.open(picture).convert("RGB")


def actions(studio: Studio) -> Image.Image:
    """Return the actions proposed from a run's laps."""
    folder = studio.folder / "proposed"
    if not folder.exists():
        studio.program("actions", str(studio.season), "--name", "proposed")
    return Image.open(folder / "actions.png").convert("RGB")


def races(studio: Studio) -> Image.Image:
    """Return a frame of a lap among boxes."""
    run = studio.train(
        "boxes",
        "experiment=object_avoidance",
        f"track={TRACK}",
        "observation=camera_small",
        "network=cnn_small",
        "budget.env_steps=400000",
    )
    film = studio.folder / "boxes.mp4"
    studio.program("watch", str(run), "-o", str(film))
    return studio.frame(film, 2.0)


def of_sweep(name: str) -> Callable[[Studio], Image.Image]:
    """Return what takes a figure from the page of a study."""

    def take(studio: Studio) -> Image.Image:
        page = studio.folder / "runs" / "pictures" / "sweep.html"
        if not page.exists():
            studio.program("sweep", *SWEEP)
        return studio.figure(page, name)

    return take


PICTURES: dict[str, Callable[[Studio], Image.Image | bytes]] = {
    "lap": lap,
    "terminal": terminal,
    "reward_map": reward_map,
    "watch": watch,
    "tutorial": tutorial,
    "stopping": of_report("training_progress"),
    "evaluation": of_report("evaluated_lap"),
    "best_checkpoint": best_checkpoint,
    "faster_laps": faster_laps,
    "analysis": of_report("off_track_risk"),
    "lap_line": of_report("lap_line"),
    "zigzag": of_report("zigzag"),
    "lineage": lineage,
    "compare": compare,
    "tracks": tracks,
    "actions": actions,
    "races": races,
    "sweeps": of_sweep("history"),
    "sweep_results": of_sweep("parallel"),
}


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Write the pictures."""
    summary, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        "benchmarks.guide_pictures",
        description=f"{summary}\n\n{usage}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="some of the pictures")
    parser.add_argument("--runs-dir", type=Path, help="folder of the runs; left out: they are not kept")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder of the pictures")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in PICTURES]
    if unknown:
        raise BadInput(f"NAME {','.join(unknown)}", "no such picture", ",".join(PICTURES))
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.runs_dir or Path(temporary) / "runs"
        folder.mkdir(parents=True, exist_ok=True)
        with browser(Path(temporary) / "chromium") as tab:
            for name in options.names or PICTURES:
                picture = PICTURES[name](Studio(folder, tab))
                file = options.output / f"{name}.webp"
                if isinstance(picture, bytes):
                    file.write_bytes(picture)
                else:
                    picture.thumbnail((WIDTH, TALLEST))
                    picture.save(file, quality=80, method=6)
                print(f"{file}: {file.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    sys.exit(main())
