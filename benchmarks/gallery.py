"""`docs/gallery.md`: every figure of a log's page, on a run of ours and on a training of the AWS console.

python -m benchmarks.gallery RUN --beside RUN RUN --console ../shared/reference/console_training
"""

import argparse
import io
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from deepracer_exp.analysis.chart import Chart
from deepracer_exp.analysis.chart_matplotlib import draw
from deepracer_exp.analysis.charts import Section, draw_sections
from deepracer_exp.analysis.log_tables import headline
from deepracer_exp.analysis.log_view import prepare
from deepracer_exp.analysis.reward_comparison import compare_rewards
from deepracer_exp.evaluation.reward_replay import replay_reward
from deepracer_exp.evaluation.run_terms import run_terms
from deepracer_exp.formats.recording_reader import read_recording

DOCS = Path(__file__).parents[1] / "docs"
IMAGES = Path("images") / "analysis"
MOST_BYTES = 150_000
_DPI, _COLORS = 75, 128
_HEAD = """\
# Gallery of log figures

Every figure of the page that `deepracer-exp analyze` writes ([analysis.md](analysis.md)), with what to see in it: on a
run of ours, then on a training of the AWS console (re:Invent 2018, June 2022; deepracer-utils' sample logs). On the
page they answer to hovering and zooming. `python -m benchmarks.gallery RUN --beside RUN --console PATH` draws them.
"""


def main() -> None:
    """Draw all figures and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("run", help="folder of a run of ours")
    parser.add_argument("--beside", nargs="*", default=[], help="runs to compare it with")
    parser.add_argument("--console", help="logs of a training of the AWS console")
    parser.add_argument("--reward", default="racing_line", help="replayed on both")
    parser.add_argument("--docs", default=str(DOCS), help="where the page and its images go")
    args = parser.parse_args()
    docs = Path(args.docs)
    (docs / IMAGES).mkdir(parents=True, exist_ok=True)
    text = _HEAD + _part("A run of ours", "own", Path(args.run), [*map(Path, args.beside)], args.reward, docs)
    if args.console:
        text += _part("A training of the AWS console", "console", Path(args.console), [], args.reward, docs)
    (docs / "gallery.md").write_text(text, encoding="utf-8")


def _part(title: str, prefix: str, log: Path, beside: Sequence[Path], reward: str, docs: Path) -> str:
    recording = read_recording(log)
    view, terms = run_terms(prepare(recording))
    sections = draw_sections(view, [prepare(read_recording(other)) for other in beside], terms)
    replayed = compare_rewards(view, replay_reward(recording, reward))
    sections.append(Section(f"Another reward function: {reward}", replayed.charts))
    text = f"\n## {title}\n\n{headline(view)}\n"
    for section in sections:
        text += f"\n### {section.title}\n"
        for chart in section.charts:
            file = _picture(chart, docs / IMAGES / f"{prefix}-{chart.name}.png")
            text += f"\n**{chart.title}** (`{chart.name}`). {chart.caption}\n\n![{chart.title}]({IMAGES / file.name})\n"
    return text


def _picture(chart: Chart, file: Path) -> Path:
    """Write a chart as a PNG of few colours, which is a quarter of the size."""
    drawn = io.BytesIO()
    draw(chart).savefig(drawn, dpi=_DPI)
    colors = _COLORS
    while True:
        Image.open(drawn).convert("RGB").quantize(colors, dither=Image.Dither.NONE).save(file, optimize=True)
        if file.stat().st_size <= MOST_BYTES or colors <= 16:
            return file
        colors //= 2


if __name__ == "__main__":
    main()
