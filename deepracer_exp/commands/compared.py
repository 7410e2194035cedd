"""What `deepracer-exp compare` compares, and the page it writes of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import writing
from deepracer_exp.runs.files import is_run

from .pages import page_name

if TYPE_CHECKING:
    from deepracer_exp.analysis.charts.figure import Chart
    from deepracer_exp.analysis.log_tables import Table
    from deepracer_exp.analysis.log_view import LogView


@dataclass(frozen=True)
class Item:
    """What a word of the command line means."""

    word: str
    group: str | None
    """Name of the group it was given to."""
    paths: tuple[Path, ...]
    """Folders of runs, or one file or folder of logs."""
    is_experiment: bool = False

    @property
    def is_logs(self) -> bool:
        """Whether it is no run of ours."""
        return not is_run(self.paths[0])


def write_comparison_page(
    output: str | None,
    items: Sequence[Item],
    sentences: Sequence[str],
    tables: "Sequence[tuple[str, Table, str]]",
    charts: "Sequence[Chart | None]",
) -> Path:
    """Write the page of a comparison, by default under the names of what is compared; return where it is.

    Raises:
        BadInput: it cannot be written.
    """
    from deepracer_exp.reports.comparison_page import write_comparison

    words = list(dict.fromkeys(item.group or Path(item.word).name for item in items))
    out = Path(output or page_name("comparison", "-".join(words[:3])))
    title = f"{', '.join(words[:4])}{' and more' * (len(words) > 4)} compared"
    with writing(f"--output {out}", "a file in a folder"):
        write_comparison(out, title, sentences, tables, [chart for chart in charts if chart is not None])
    return out


def light(view: "LogView") -> "LogView":
    """Return a view without the steps of its training: a comparison shows iterations and races only."""
    steps = view.recording.steps
    recording = replace(view.recording, steps=steps[steps["stream"] != "training"].copy())
    return replace(view, steps=view.steps.iloc[:0].copy(), recording=recording)
