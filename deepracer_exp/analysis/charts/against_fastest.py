"""The figure of a lap against the fastest lap of its car."""

import numpy as np

from deepracer_exp.analysis.against_fastest import CAUSES, loss, lost_in_words
from deepracer_exp.analysis.log_view import LogView

from .figure import Chart, Panel, bars
from .runs import run_folder
from .style import BLUE, ORANGE, VERMILION

_COLORS = dict(zip(CAUSES, (BLUE, ORANGE, VERMILION), strict=True))
_WIDTH = 0.26


def against_fastest(view: LogView) -> Chart | None:
    """Draw the seconds that a run's lap loses to the fastest lap of its car, by sector and cause."""
    folder = run_folder(view)
    lost = None if folder is None else loss(view, folder)
    if lost is None:
        return None
    table = lost.by_sector
    places = np.arange(len(table))
    layers = [
        bars(places + (number - 1) * _WIDTH, table[cause].to_numpy(), _COLORS[cause], cause, width=_WIDTH)
        for number, cause in enumerate(CAUSES)
    ]
    return Chart(
        name="against_fastest",
        title="Seconds lost to the fastest lap of this car",
        caption=f"The fastest {view.lap_word} from the start line: {lost_in_words(lost)}. Line is a longer way, "
        "steering the way that turning to and fro adds to it, speed the rest; below zero the lap gains. The fastest "
        "lap itself: `deepracer-exp tracks NAME --fastest`.",
        rows=[[Panel(layers=layers, y_label="seconds lost", x_names=list(table.index))]],
    )
