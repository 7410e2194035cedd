"""Figures of races among boxes and bots: laps without a crash, places and objects of crashes, and overtaking."""

import numpy as np

from deepracer_exp.reports.tables.log_view import LogView, thirds
from deepracer_exp.reports.tables.others_on_road import RIVAL, OthersOnRoad
from deepracer_exp.reports.tables.statistics import count_rows, subsample, wilson

from .figure import Chart, Layer, Panel, bars, line, points
from .maps import map_panel, outlines, waypoint_panel
from .style import BLUE, CATEGORIES, GREEN, INK, VERMILION

_SHOWN = 1500
"""Most symbols of one colour on a map."""


def crash_free(view: LogView) -> Chart | None:
    """Draw the share of laps without a crash, and of episodes that crash, over the iterations."""
    if view.others is None or not view.trained:
        return None
    ended = view.episodes[view.episodes["ended"]]
    by_iteration = ended.groupby("iteration")["status"]
    crashed = by_iteration.apply(lambda status: 100 * (status == "crashed").mean())
    complete = by_iteration.apply(lambda status: 100 * (status == "lap_complete").mean())
    layers: list[Layer] = [
        line(complete.index, complete, BLUE, "exploring episodes that complete the lap without a crash"),
        line(crashed.index, crashed, VERMILION, "exploring episodes that crash"),
    ]
    if view.run is not None:
        evaluated = view.run.evaluations.dropna(subset=["crash_free"])
        if len(evaluated):
            layers.append(
                line(
                    evaluated["iteration"],
                    100 * evaluated["crash_free"],
                    GREEN,
                    "evaluated laps without a crash",
                )
            )
            layers[-1].update(mode="lines+markers")
    return Chart(
        name="crash_free",
        title="Laps without a crash",
        caption="A crash ends an exploring episode, so every complete exploring lap is one without a crash. Evaluated "
        "laps take the most probable actions; those that leave the road do not count as laps without a crash.",
        rows=[[Panel(layers=layers, x_label="iteration", y_label="per cent", y_range=(-3.0, 103.0))]],
    )


def crash_places(view: LogView) -> Chart | None:
    """Draw where cars ran into which box or bot, and the boxes that stand at the same places in every episode."""
    others = view.others
    if others is None or not len(others.crashes) or view.course is None:
        return None
    n = view.waypoint_count
    placed: list[Layer] = []
    counted: list[Layer] = []
    base = np.zeros(n)
    if len(others.corners):
        placed.append(outlines(others.corners, INK, "boxes", width=2.0))
    for number, name in enumerate(others.names):
        rows = others.crashes["row"].to_numpy()[others.crashes["other"] == number]
        if not len(rows):
            continue
        color = CATEGORIES[number % len(CATEGORIES)]
        waypoint = np.maximum(view.steps["closest_waypoint"].to_numpy(np.intp)[rows], 0)
        height = count_rows(waypoint, n)
        counted.append(bars(np.arange(n), height, color, f"{name} ({len(rows)})", base=base, width=1.0))
        base = base + height
        shown = view.steps.iloc[rows[subsample(len(rows), _SHOWN)]]
        hover = [
            f"{name}: episode {row.episode}{f', iteration {row.iteration}' * view.trained}\n"
            f"waypoint {row.closest_waypoint}, {row.progress:.1f}% of the lap"
            for row in shown.itertuples()
        ]
        placed.append(points(shown["X"], shown["Y"], color, symbol="triangle-up", size=6.0, hover=hover))
    return Chart(
        name="crash_places",
        title=f"Where it crashes: {len(others.crashes):,} crashes by object and place",
        caption="Each symbol is the front of the car in the step of a crash, in the colour of what it ran into."
        + _numbering(others)
        + " The outlines are the boxes that stand at the same places in every episode."
        * bool(len(others.corners)),
        rows=[[map_panel(view.course, placed)], [waypoint_panel(counted, "crashes", n)]],
    )


def crashes_by_object(view: LogView) -> Chart | None:
    """Draw the crash rate at each box or bot: in all iterations and in the last third."""
    others = view.others
    if others is None or not len(others.crashes):
        return None
    late = thirds(view.steps["iteration"].to_numpy()) == 2
    layers: list[Layer] = []
    place = np.arange(len(others.names))
    groups = [("all iterations", None, BLUE), ("last third of the iterations", late, GREEN)]
    for shift, (label, rows, color) in enumerate(groups if view.trained else [("", None, BLUE)]):
        table = others.table(rows)
        risk = table["risk"].to_numpy()
        met = (table["crashes"] + table["passed"]).to_numpy()
        x = place + (0.4 * shift - 0.2) * view.trained
        layers.append(bars(x, 100 * risk, color, label, width=0.36))
        low, high = wilson(table["crashes"].to_numpy(), met)
        texts = [
            f"{name}: {crashes} crashes in {there} meetings"
            for name, crashes, there in zip(others.names, table["crashes"], met, strict=True)
        ]
        layers[-1].update(
            hovertext=texts,
            hoverinfo="text",
            error_y={
                "type": "data",
                "symmetric": False,
                "array": np.nan_to_num(100 * (high - risk)).tolist(),
                "arrayminus": np.nan_to_num(100 * (risk - low)).tolist(),
                "color": INK,
                "thickness": 1,
                "width": 3,
            },
        )
    kinds = _kinds(others)
    return Chart(
        name="crashes_by_object",
        title=f"Which {' or '.join(kinds)} costs most"
        if len(others.names) > 1
        else f"Crashes with the {kinds[0]}",
        caption="Share of the times the car came to each that ended in a crash, with intervals of 95% (Wilson)."
        + _numbering(others),
        rows=[[Panel(layers=layers, y_label="crashes, per cent of meetings", x_names=list(others.names))]],
    )


def overtakes(view: LogView) -> Chart | None:
    """Draw where the car overtakes bots or its rival, and where these come past it."""
    others = view.others
    if others is None or not others.drive or view.course is None:
        return None
    passes = others.passes[others.passes["other"] >= others.boxes]
    if not len(passes):
        return None
    n = view.waypoint_count
    placed: list[Layer] = []
    counted: list[Layer] = []
    for overtaken, words, color in (
        (True, f"overtakes {others.drive}", GREEN),
        (False, f"is passed by {others.drive}", VERMILION),
    ):
        rows = passes["row"].to_numpy()[passes["overtaken"] == overtaken]
        if not len(rows):
            continue
        waypoint = np.maximum(view.steps["closest_waypoint"].to_numpy(np.intp)[rows], 0)
        counted.append(
            bars(np.arange(n), count_rows(waypoint, n), color, f"{words} ({len(rows)})", width=1.0)
        )
        shown = view.steps.iloc[rows[subsample(len(rows), _SHOWN)]]
        placed.append(points(shown["X"], shown["Y"], color, size=4.0))
    return Chart(
        name="overtakes",
        title="Where it overtakes",
        caption=f"Each dot is the front of the car where it gets ahead of {others.drive}, or falls behind."
        + " A rival may stand there, because it has left the track." * (RIVAL in others.names),
        rows=[[map_panel(view.course, placed)], [waypoint_panel(counted, "times", n)]],
    )


def _kinds(others: OthersOnRoad) -> list[str]:
    """Return which kinds of others there are: `box`, `bot`, `rival`."""
    return list(dict.fromkeys(name.split()[0] for name in others.names))


def _numbering(others: OthersOnRoad) -> str:
    """Return a sentence that explains the numbers of boxes and bots, if there are any."""
    numbered = [{"box": "boxes", "bot": "bots"}[kind] for kind in _kinds(others) if kind != RIVAL]
    if not numbered:
        return ""
    words = " and ".join(numbered).capitalize()
    return f" {words} are numbered along the lap from the start line, separately in each episode."
