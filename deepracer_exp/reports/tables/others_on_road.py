"""Boxes, bots and rivals around the cars of a log: their places, crashes into them, and passes."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.aws.logs.recorded import Recording
from deepracer_exp.config.custom_files.job_race import recorded_race
from deepracer_exp.env.others.boxes_and_bots import BOX_M, CAR_M, first_hit
from deepracer_exp.env.others.placement import (
    PlacedOthers,
    Placement,
    box_corners_of,
    draw_placements,
    rebuild_poses,
)
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.recording import CONTROL_PERIOD_S
from deepracer_exp.tracks.track import Track

from .statistics import Values, wilson
from .step_columns import begins_of

ORIGIN_BEHIND_M = 0.14
"""Distance from the logged point, the front of the car, back to its origin (deepracer-simapp)."""
NEAR_M = 2.0
"""Gap along the lap up to which getting ahead of something counts as a pass, not as a jump."""
_TOUCHED_M = 0.6
"""Distance between the origins of a car and a candidate for its crash."""
_EPISODES = 2000
"""Episodes whose poses are rebuilt together: 100 MB with six others."""

RIVAL = "rival"
"""Name of the other car of a race head to head."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OthersOnRoad:
    """The others of a log's episodes, as far as their places are known."""

    names: tuple[str, ...]
    """`box 1`, ..., `bot 1`, ...: boxes and then bots, each in the order of the lap, and then `RIVAL`; (K,)."""
    boxes: int
    """Number of boxes among them."""
    corners: NDArray[np.float64]
    """Corners of boxes whose places are the same in every episode, (boxes, 4, 2); (0, 4, 2) without such boxes."""
    lap_share: Values
    """Positions of these as shares of the lap, (boxes,); empty where they move between episodes."""
    crashes: pd.DataFrame
    """One row for each crash: `row` of the steps and `other`, its index."""
    passes: pd.DataFrame
    """One row per overtake, by the car (`overtaken`) or of the car: `row`, `other`."""

    @property
    def drive(self) -> str:
        """Name the moving others: `a bot`, `its rival`, or an empty string."""
        if len(self.names) == self.boxes:
            return ""
        return f"its {RIVAL}" if self.names[-1] == RIVAL else "a bot"

    def table(self, rows: NDArray[np.bool_] | None = None) -> pd.DataFrame:
        """Return crashes and passes of each of the others, (K,): `crashes`, `passed`, `risk` of a crash in a meeting.

        `rows` are the rows of the steps that count; None: all.
        """
        crashed, passed = self.crashes, self.passes[self.passes["overtaken"]]
        if rows is not None:
            crashed, passed = crashed[rows[crashed["row"]]], passed[rows[passed["row"]]]
        crashes, over = (
            np.bincount(some["other"], minlength=len(self.names)).astype(np.int64)
            for some in (crashed, passed)
        )
        risk = crashes / np.maximum(crashes + over, 1)
        return pd.DataFrame({"crashes": crashes, "passed": over, "risk": risk}, index=list(self.names))


def others_on_road(recorded: PlacedOthers, steps: pd.DataFrame, course: Track) -> OthersOnRoad | None:
    """Return the others around the cars of a log; None if no episode's are known.

    Args:
        recorded: the episodes whose others are known.
        steps: rows by episode and time with `X`, `Y`, `yaw`, `steps` and `episode_status`.
        course: that was driven on.
    """
    race, placed = recorded.race, recorded.on(course)
    number = steps["episode"].to_numpy()
    first = np.flatnonzero(np.diff(number, prepend=-1) != 0)
    ends = np.append(first[1:], len(steps))
    driven = [place for place, episode in enumerate(number[first].tolist()) if episode in placed]
    if not driven:
        return None
    crashes: list[pd.DataFrame] = []
    passes: list[pd.DataFrame] = []
    for begin in range(0, len(driven), _EPISODES):
        some = driven[begin : begin + _EPISODES]
        rows = np.concatenate([np.arange(first[place], ends[place]) for place in some])
        of_episode = np.repeat(np.arange(len(some)), [ends[place] - first[place] for place in some])
        placements = [placed[int(number[first[place]])] for place in some]
        tables = _crashes_and_passes(recorded, placements, steps.iloc[rows], of_episode, course)
        for table, collected in zip(tables, (crashes, passes), strict=True):
            collected.append(table.assign(row=rows[table["row"]]))
    boxes = race.boxes.count
    corners, lap_share = np.zeros((0, 4, 2)), np.zeros(0)
    every = np.stack([placed[int(number[first[place]])].places_m[:boxes] for place in driven])
    lanes = np.stack([placed[int(number[first[place]])].lanes[:boxes] for place in driven])
    if boxes and np.ptp(every, axis=0).max() < 1e-6 and not np.ptp(lanes, axis=0).any():
        lap_share = every[0] / course.length_m
        corners = box_corners_of(race, course, placed[int(number[first[driven[0]]])])
    names = [f"box {number}" for number in range(1, boxes + 1)]
    names += [f"bot {number}" for number in range(1, race.bots.count + 1)]
    names += [RIVAL] * (race.rivals is not None)
    return OthersOnRoad(
        names=tuple(names),
        boxes=boxes,
        corners=corners,
        lap_share=lap_share,
        crashes=pd.concat(crashes, ignore_index=True),
        passes=pd.concat(passes, ignore_index=True),
    )


def placed_in_log(recording: Recording, steps: pd.DataFrame, course: Track | None) -> PlacedOthers | None:
    """Return the others of the episodes of a service log, as far as the parameters of its job give their places.

    Bots are driven by the control steps; stops after hitting the car are not logged.

    Args:
        recording: with the parameters about boxes and bots.
        steps: as for `others_on_road`.
        course: that was driven on; None: it is not known.
    """
    if course is None:
        return None
    try:
        race = recorded_race(recording.race)
    except BadInput:
        return None
    if race is None or (race.bots.count and not course.closed):
        return None
    length_m, first = np.array([course.length_m]), np.zeros(1, np.int64)
    places_m, lanes = draw_placements(race, length_m, first, np.zeros(1, np.uint64))
    placed = dict.fromkeys(steps["episode"].unique().tolist(), Placement(places_m[0], lanes[0], 0))
    return PlacedOthers(race=race, episodes={course.reversed: placed}, period_s=CONTROL_PERIOD_S)


def _crashes_and_passes(
    recorded: PlacedOthers,
    placements: list[Placement],
    steps: pd.DataFrame,
    of_episode: NDArray[np.intp],
    course: Track,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return crashes and passes of some episodes; `row` counts the rows of `steps`."""
    race, step = recorded.race, steps["steps"].to_numpy(np.int64)
    poses, distance_m = rebuild_poses(race, course, placements, recorded.period_s, of_episode, step)
    x, y, yaw_rad = (steps[name].to_numpy(np.float64) for name in ("X", "Y", "yaw"))
    yaw_rad = np.radians(yaw_rad)
    status = steps["episode_status"].astype(str).to_numpy()
    begins = np.append(True, np.diff(of_episode) != 0)
    crashed = np.flatnonzero(begins_of(status == "crashed", begins))
    # A crash is judged by where the bots were a step before, and by where a rival is.
    lagged = poses[np.where(begins[crashed], crashed, crashed - 1)]
    if race.rivals is not None:
        lagged[:, -1] = poses[crashed, -1]
    origin = (
        x[crashed] - ORIGIN_BEHIND_M * np.cos(yaw_rad[crashed]),
        (y[crashed] - ORIGIN_BEHIND_M * np.sin(yaw_rad[crashed])),
    )
    is_bot = np.arange(race.others) >= race.boxes.count
    half_m = 0.5 * np.where(is_bot[:, None], CAR_M, BOX_M)
    hit = np.asarray(first_hit(*origin, yaw_rad[crashed], lagged, half_m))
    away_m = np.hypot(lagged[..., 0] - origin[0][:, None], lagged[..., 1] - origin[1][:, None])
    away_m[np.isnan(away_m)] = np.inf  # a rival that was not recorded
    # Recorded poses and boxes are not those of the physics to the last digit.
    hit = np.where(hit >= 0, hit, np.where(away_m.min(axis=1) < _TOUCHED_M, away_m.argmin(axis=1), -1))
    crashed, hit = crashed[hit >= 0], hit[hit >= 0]
    length_m = course.length_m
    at_m = course.project(np.column_stack([x, y])).distance_m
    gap_m = np.mod(distance_m - at_m[:, None] + 0.5 * length_m, length_m) - 0.5 * length_m
    near = (np.abs(gap_m[1:]) < NEAR_M) & (np.abs(gap_m[:-1]) < NEAR_M) & ~begins[1:, None]
    changed = near & ((gap_m[1:] > 0) != (gap_m[:-1] > 0))
    row, other = np.nonzero(changed)
    return (
        pd.DataFrame({"row": crashed, "other": hit}),
        pd.DataFrame({"row": row + 1, "other": other, "overtaken": gap_m[row + 1, other] <= 0}),
    )


def costliest(
    others: OthersOnRoad, rows: NDArray[np.bool_]
) -> tuple[str, dict[str, float | int | str]] | None:
    """Return a sentence on the object with most crashes, and its numbers; None without a crash.

    `rows` are the rows of the steps that count.
    """
    table = others.table(rows)
    crashes = int(table["crashes"].sum())
    if not crashes:
        return None
    worst = int(table["crashes"].to_numpy().argmax())
    name, row = others.names[worst], table.iloc[worst]
    met = int(row["crashes"] + row["passed"])
    low, high = map(float, wilson(int(row["crashes"]), met))
    where = f" (at {100 * others.lap_share[worst]:.0f}% of the lap)" if worst < len(others.lap_share) else ""
    subject = "Its rival" if name == RIVAL else name.capitalize()
    sentence = (
        f"{subject}{where} costs most: {int(row['crashes'])} of {crashes} crashes, a crash in "
        f"{row['risk']:.0%} of the {met:,} times the car came to it ({low:.0%} to {high:.0%} with 95% confidence)."
    )
    if others.drive:
        overtaken = int(table["passed"].iloc[others.boxes :].sum())
        sentence += f" It overtook {others.drive.replace('a bot', 'bots')} {overtaken:,} times."
    values: dict[str, float | int | str] = {"costs_most": name, "crashes": int(row["crashes"]), "met": met}
    return sentence, values | {"all_crashes": crashes, "risk": float(row["risk"])}
