"""The picture of an action space that is proposed from laps: their commands, and the chosen actions."""

import io

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from deepracer_exp.reports.tables.proposed_actions import ActionProposal

from .style import FAINT, GRID, INK, PAPER, SPINE

_COLORS = [*matplotlib.color_sequences["tab20"][::2], *matplotlib.color_sequences["tab20"][1::2]]
_SMALLEST, _LARGEST = 40.0, 900.0
"""Areas of an action that is nearest to no command, and to all of them, in square points."""


def proposed_actions_picture(title: str, proposal: ActionProposal) -> bytes:
    """Draw the commands of the laps and the chosen actions, larger the more commands they stand for; return a PNG."""
    listed, shares = np.array(proposal.actions), proposal.shares
    colors = np.array([_COLORS[number % len(_COLORS)] for number in range(len(listed))])
    commands = proposal.commands
    figure = Figure((9.0, 5.4), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.scatter(
        commands.steering_deg,
        commands.speed_mps,
        s=9,
        color=colors[proposal.nearest],
        alpha=0.45,
        linewidth=0,
        zorder=2,
    )
    area = _SMALLEST + (_LARGEST - _SMALLEST) * shares
    for rescue, marker, label in (
        (False, "o", "chosen: centre of a cluster of commands"),
        (True, "s", "added to recover with"),
    ):
        chosen = np.array(proposal.to_recover) == rescue
        axes.scatter(
            listed[chosen, 0],
            listed[chosen, 1],
            s=area[chosen],
            marker=marker,
            color=colors[chosen],
            edgecolor=INK,
            linewidth=1.4,
            clip_on=False,
            zorder=3,
        )
        axes.scatter([], [], s=70, marker=marker, color=PAPER, edgecolor=INK, label=label)
    for number, (steering_deg, speed_mps) in enumerate(listed):
        axes.annotate(
            str(number),
            (steering_deg, speed_mps),
            (0, 4 + np.sqrt(area[number]) / 2),
            textcoords="offset points",
            ha="center",
            fontsize=9,
            color=INK,
        )
    axes.scatter([], [], s=9, color=FAINT, label="commands of the laps")
    figure.legend(loc="outside lower left", ncols=3, frameon=False, fontsize=9, labelcolor=INK)
    axes.set_title(title, loc="left", fontsize=13, fontweight="bold", color=INK, pad=14)
    # Left is on the left.
    axes.invert_xaxis()
    axes.xaxis.set_major_formatter(lambda x, _: f"{abs(x):g}")
    axes.set_xlabel("left  ←  steering, degrees  →  right", color=FAINT)
    axes.set_ylabel("speed, m/s", color=FAINT)
    axes.margins(0.05, 0.12)
    axes.set_axisbelow(True)
    axes.grid(color=GRID)
    axes.tick_params(length=0, labelcolor=FAINT)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(SPINE)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()
