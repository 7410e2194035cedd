"""Results of an evaluation: the attempted laps by track and condition, with their statistics."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.runs.run_result import RELIABLE

from .race_protocol import Attempt
from .zigzag import ZigZag

Metric = Literal["progress", "lap_time", "race_score", "reliable_lap"]
Rank = tuple[float, float]
"""Compared in order, higher is better."""
Interval = tuple[float, float]

USUAL, HELD_OUT = "usual", "held_out"
"""Names of the conditions."""
CONFIDENCE = 0.95
NOTHING = "\N{EN DASH}"
_RESAMPLES = 9999


@dataclass(frozen=True, eq=False)
class TrialGroup:
    """Trials on one track under one condition, or several such groups combined.

    A lap interrupted by the end of the race does not count, unless its trial has no other.
    """

    track: str
    condition: str
    trials: tuple[int, ...]
    """Rows of the batch."""
    attempts: tuple[Attempt, ...]
    zigzags: "tuple[ZigZag, ...]" = ()
    """Zig-zag of each trial; empty where it was not measured."""
    won: tuple[float, ...] = ()
    """Result of each trial against a rival: 1 won, 0.5 drawn, 0 lost; empty where there was none."""

    @property
    def decided(self) -> list[Attempt]:
        """The laps that count."""
        has = {attempt.trial for attempt in self.attempts if not attempt.cut_off}
        return [a for a in self.attempts if not a.cut_off or a.trial not in has]

    @property
    def lap_times_s(self) -> NDArray[np.float64]:
        """Times of the complete laps, including penalties."""
        return np.array([attempt.time_s for attempt in self.attempts if attempt.complete])

    @property
    def completion(self) -> float:
        """Mean progress of the attempted laps in per cent."""
        return float(np.mean([attempt.progress for attempt in self.decided]))

    @property
    def lap_share(self) -> float:
        """Complete laps per attempted lap."""
        return len(self.lap_times_s) / len(self.decided)

    @property
    def crash_free_share(self) -> float:
        """Complete laps without a crash per attempted lap."""
        return sum(attempt.crash_free for attempt in self.decided) / len(self.decided)

    @property
    def won_share(self) -> float:
        """Races won per race, a draw counting half; NaN where there was no rival."""
        return float(np.mean(self.won)) if self.won else math.nan

    @property
    def mean_lap_time_s(self) -> float | None:
        """Mean time of the complete laps, None without one."""
        times = self.lap_times_s
        return float(times.mean()) if len(times) else None

    @property
    def race_score_s(self) -> float | None:
        """Seconds per complete lap, including penalties and failed laps; None without a complete lap."""
        laps = len(self.lap_times_s)
        return sum(attempt.time_s for attempt in self.decided) / laps if laps else None

    @property
    def zigzag(self) -> ZigZag:
        """The zig-zag on straights in all trials together."""
        return sum(self.zigzags, ZigZag())

    def rank(self, metric: Metric) -> Rank:
        """Return the policy's rank by a metric; without a complete lap, times fall back to progress.

        `reliable_lap` ranks mean lap times of policies that complete `RELIABLE` of their laps above all others, which
        rank by progress.
        """
        if metric == "reliable_lap" and self.lap_share < RELIABLE:
            return 0.0, self.completion
        if metric == "progress":
            mean = self.mean_lap_time_s
            return self.completion, 0.0 if mean is None else 1 / mean
        score = self.race_score_s if metric == "race_score" else self.mean_lap_time_s
        return (0.0, self.completion) if score is None else (1.0, -score)

    def statistics(self) -> dict[str, Any]:
        """Return the reported statistics, each mean with its bootstrap interval; JSON types.

        Trials are resampled, not laps: the laps of a trial are not independent.
        """
        times = self.lap_times_s
        decided = self.decided
        count = self._per_trial(decided, lambda _: 1.0)
        complete = self._per_trial(decided, lambda a: float(a.complete))
        once = np.ones(len(self.trials))
        return {
            "trials": len(self.trials),
            "laps_tried": len(decided),
            "laps": len(times),
            "completion": _mean(self._per_trial(decided, lambda a: a.progress), count),
            "lap_share": _mean(complete, count),
            "lap_time_s": {
                **_mean(self._per_trial(decided, lambda a: a.time_s * a.complete), complete),
                "median": _or_none(np.median, times),
                "best": _or_none(np.min, times),
                "std": _or_none(np.std, times),
            },
            "resets": _mean(self._per_trial(self.attempts, lambda a: float(a.resets)), once),
            "penalty_s": _mean(self._per_trial(self.attempts, lambda a: a.penalty_s), once),
            "crashes": _mean(self._per_trial(self.attempts, lambda a: float(a.crashes)), once),
            "crash_free": _mean(self._per_trial(decided, lambda a: float(a.crash_free)), count),
            "race_score_s": self.race_score_s,
            "zigzag": self._zigzag_statistics(),
            **({"won": _mean(np.array(self.won), once)} if self.won else {}),
        }

    def _zigzag_statistics(self) -> dict[str, Any]:
        changes, straight_m = (
            np.array([getattr(part, name) for part in self.zigzags], np.float64)
            for name in ("changes", "straight_m")
        )
        whole = self.zigzag
        return {
            "changes_per_m": _mean(changes, straight_m),
            "amplitude_deg": whole.amplitude_deg,
            "lost_s": whole.lost_s,
            "straight_m": whole.straight_m,
        }

    def _per_trial(self, attempts: Sequence[Attempt], value: Any) -> NDArray[np.float64]:
        place = {trial: index for index, trial in enumerate(self.trials)}
        sums = np.zeros(len(self.trials))
        for attempt in attempts:
            sums[place[attempt.trial]] += value(attempt)
        return sums


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Results of one policy."""

    groups: tuple[TrialGroup, ...]
    """One for each track and condition, track by track."""
    among_others: bool = False
    """Whether there were boxes or bots on the road."""

    @property
    def tracks(self) -> list[str]:
        """Names of the tracks."""
        return list(dict.fromkeys(group.track for group in self.groups))

    @property
    def conditions(self) -> list[str]:
        """Names of the conditions."""
        return list(dict.fromkeys(group.condition for group in self.groups))

    def on(self, condition: str) -> TrialGroup:
        """Return a condition's trials on all tracks."""
        groups = [group for group in self.groups if group.condition == condition]
        return _together(groups, "all tracks", condition)

    @property
    def race_score_s(self) -> float | None:
        """Race score on usual and held-out conditions together, mean over tracks; None without a lap on every track."""
        tracks_with_lap, negative_s = self.rank("race_score")
        return -negative_s if tracks_with_lap == 1.0 else None

    @property
    def lap_time_s(self) -> float | None:
        """Mean time of the complete usual laps, mean over tracks; None without a lap on every track."""
        means_s = [group.mean_lap_time_s for group in self.groups if group.condition == USUAL]
        timed_s = [mean_s for mean_s in means_s if mean_s is not None]
        return float(np.mean(timed_s)) if len(timed_s) == len(means_s) else None

    def rank(self, metric: Metric) -> Rank:
        """Return the policy's rank by a metric: of usual and held-out laps together, by `reliable_lap` of usual ones.

        A few laps on the usual conditions cannot distinguish a policy that completes 19 of 20 laps from one that
        completes all, so held-out laps count too, unless the fastest lap is wanted. On several tracks, times are means
        over tracks, and one more track with a complete (for `reliable_lap`: reliable) lap outranks any time, because
        lap times of different tracks do not compare.
        """
        counted = [group for group in self.groups if metric != "reliable_lap" or group.condition == USUAL]
        by_track = [[group for group in counted if group.track == track] for track in self.tracks]
        ranks = [
            _together(groups, track, "all").rank(metric)
            for track, groups in zip(self.tracks, by_track, strict=True)
        ]
        if metric == "progress":
            first, second = np.mean(ranks, axis=0)
            return float(first), float(second)
        timed = [value for finished, value in ranks if finished]
        return len(timed) / len(ranks), float(np.mean(timed or [value for _, value in ranks]))

    def as_dict(self) -> dict[str, Any]:
        """Return everything, JSON types."""
        return {
            "groups": [
                {
                    "track": group.track,
                    "condition": group.condition,
                    **group.statistics(),
                    "attempts": [asdict(attempt) for attempt in group.attempts],
                }
                for group in self.groups
            ]
        }


def zigzag_columns(group: TrialGroup) -> dict[str, float | None]:
    """Return the zig-zag of a group by the names of its metrics, as in metrics.jsonl."""
    zigzag = group.zigzag
    return {
        "eval_zigzag_per_m": zigzag.changes_per_m,
        "eval_zigzag_deg": zigzag.amplitude_deg,
        "eval_zigzag_lost_s": zigzag.lost_s,
    }


EVAL_COLUMNS = (
    "eval_completion",
    "held_out_completion",
    "eval_lap_share",
    "eval_laps",
    "eval_laps_tried",
    "eval_lap_time_s",
    "eval_race_score_s",
    "eval_zigzag_per_m",
    "eval_zigzag_deg",
    "eval_zigzag_lost_s",
)
NOT_EVALUATED: dict[str, float | None] = dict.fromkeys(EVAL_COLUMNS)
AMONG_OTHERS = ("eval_crash_free", "eval_won")
"""Further columns of an evaluation among boxes or bots, or against a rival, in rows with an evaluation only."""


def eval_columns(evaluation: Evaluation) -> dict[str, float | None]:
    """Return the columns of an evaluation in metrics.jsonl: `EVAL_COLUMNS`, and those of `AMONG_OTHERS` that apply."""
    usual = evaluation.on(USUAL)
    held_out = evaluation.on(HELD_OUT) if HELD_OUT in evaluation.conditions else None
    return {
        "eval_completion": usual.completion,
        "held_out_completion": None if held_out is None else held_out.completion,
        "eval_lap_share": usual.lap_share,
        "eval_laps": len(usual.lap_times_s),
        "eval_laps_tried": len(usual.decided),
        "eval_lap_time_s": evaluation.lap_time_s,
        "eval_race_score_s": evaluation.race_score_s,
        **zigzag_columns(usual),
        **({"eval_crash_free": usual.crash_free_share} if evaluation.among_others else {}),
        **({"eval_won": usual.won_share} if usual.won else {}),
    }


def number(value: float | None, digits: int) -> str:
    """Return a number with so many digits, a dash for None and NaN."""
    return NOTHING if value is None or math.isnan(value) else f"{value:.{digits}f}"


def _together(groups: Sequence[TrialGroup], track: str, condition: str) -> TrialGroup:
    return TrialGroup(
        track,
        condition,
        tuple(trial for group in groups for trial in group.trials),
        tuple(attempt for group in groups for attempt in group.attempts),
        tuple(zigzag for group in groups for zigzag in group.zigzags),
        tuple(result for group in groups for result in group.won),
    )


def _mean(sums: NDArray[np.float64], counts: NDArray[np.float64]) -> dict[str, Any]:
    """Return the mean over all trials' values, and its interval if at least two trials have values.

    Args:
        sums: of each trial's values, (n,).
        counts: number of these values, (n,).
    """
    has = counts > 0
    sums, counts = sums[has], counts[has]
    if not len(sums):
        return {"mean": None, "interval": None}
    return {"mean": float(sums.sum() / counts.sum()), "interval": _interval(sums, counts)}


def _interval(sums: NDArray[np.float64], counts: NDArray[np.float64]) -> Interval | None:
    if len(sums) < 2:
        return None
    # The percentile method: the bias-corrected ones fail if all trials are alike. `scipy.stats.bootstrap` returns the
    # same, and takes a second to import.
    drawn = np.random.default_rng(0).integers(0, len(sums), (_RESAMPLES, len(sums)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    outside = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(means, [outside, 100.0 - outside])
    return float(low), float(high)


def _or_none(what: Any, values: NDArray[np.float64]) -> float | None:
    return float(what(values)) if len(values) else None
