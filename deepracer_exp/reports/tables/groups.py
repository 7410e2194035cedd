"""Groups of runs that differ in their seeds: names, scores and differences."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from deepracer_exp.files import read_yaml
from deepracer_exp.runs.lineage import course_names, run_differences
from deepracer_exp.runs.run_files import OVERRIDES, WRITTEN, RunRecord
from deepracer_exp.runs.run_result import FIGURES, result_of

from .comparison import value_text
from .evidence import Difference, Estimate, difference, estimate, interquartile_mean
from .statistics import Values

FORMS = {attribute: (name, form, better) for name, attribute, form, better in FIGURES}
"""Name and unit, format and direction of each figure in which groups are compared: attributes of RunResult."""
_NOT_OF_GROUP = ("seed", "name", "code")
_UNNAMED = ("seed", "name", "runs_dir", "tracking", "report", "debug", "track")
"""Keys of overrides that are no part of a group's name."""
_MOST_WORDS, _MOST_LETTERS = 3, 44
"""Most settings in the name of a group, and most letters in all; there is at least one setting."""


@dataclass(frozen=True)
class RunGroup:
    """Runs that are alike but for their seed, and for their track if they have several."""

    name: str
    records: tuple[RunRecord, ...]

    @property
    def courses(self) -> list[str]:
        """Return the tracks on which its policies are evaluated, in the order of the runs."""
        return list(dict.fromkeys(map(course_of, self.records)))

    def on(self, course: str) -> "RunGroup":
        """Return its runs on one track."""
        return RunGroup(self.name, tuple(record for record in self.records if course_of(record) == course))

    def scores(self, figure: str) -> Values:
        """Return a figure of the best checkpoints, one of FIGURES; infinity where a lap was never completed.

        Runs that have no evaluation are left out.
        """
        lacking = math.inf if FORMS[figure][2] < 0 else math.nan
        results = [result_of(record.summary) for record in self.records]
        values = [
            lacking if (value := getattr(result, figure)) is None else value
            for result in results
            if result is not None and result.evaluated
        ]
        numbers = np.array(values, np.float64)
        return numbers[~np.isnan(numbers)]

    def estimate(self, figure: str) -> Estimate | None:
        """Return the interquartile mean of a figure on the tracks of the group together; None without a score."""
        scores = self.scores(figure)
        return estimate([scores]) if len(scores) else None


def course_of(record: RunRecord) -> str:
    """Return the name of the track, or of several, on which a run's policies are evaluated."""
    evaluated = (record.config.get("evaluation") or {}).get("tracks")
    if evaluated:
        return ", ".join(evaluated)
    track = record.config.get("track")
    direction = track.get("direction", "forward") if isinstance(track, Mapping) else "forward"
    return course_names(track) + f", {direction}" * (direction != "forward")


def group_runs(named: Iterable[tuple[str | None, RunRecord]]) -> list[RunGroup]:
    """Put runs into groups.

    Each run comes with the name of its group; None: it joins the runs whose settings differ in seed, track, experiment
    and version of the code only.
    """
    pairs = list(named)
    records = [record for _, record in pairs]
    differences = run_differences(records)
    evaluated_alike = len({course_of(record) for record in records}) == 1
    deciding = [
        key
        for key in differences
        if key not in _NOT_OF_GROUP and (evaluated_alike or key.partition(".")[0] != "track")
    ]
    members: dict[str, list[int]] = {}
    for number, (name, _) in enumerate(pairs):
        settings = json.dumps([differences[key][number] for key in deciding])
        members.setdefault(f"={name}" if name is not None else settings, []).append(number)
    names = {key: pairs[numbers[0]][0] for key, numbers in members.items()}
    open_groups = {key: numbers[0] for key, numbers in members.items() if names[key] is None}
    labels = _labels([records[number] for number in open_groups.values()])
    if len(set(labels)) < len(labels):
        labels = [
            _label(f"{key}={value_text(differences[key][number], 24)}" for key in deciding)
            for number in open_groups.values()
        ]
    for number, (key, label) in enumerate(zip(open_groups, labels, strict=True), 1):
        names[key] = label if labels.count(label) == 1 else f"{label} ({number})"
    return [
        RunGroup(str(names[key]), tuple(records[number] for number in numbers))
        for key, numbers in members.items()
    ]


def _labels(records: Sequence[RunRecord]) -> list[str]:
    """Return a name for each run: the overrides in which it differs from the others."""
    chosen = [_overrides(record.path) for record in records]
    keys = dict.fromkeys(key for words in chosen for key in words)
    distinct = {key: len({words.get(key) for words in chosen}) for key in keys}
    # The most informative keys come first, since not all have room.
    differing = sorted((key for key in keys if distinct[key] > 1), key=lambda key: -distinct[key])
    if not differing:
        return [str(record.config.get("name") or record.name) for record in records]
    return [
        _label(f"{key}={value_text(words.get(key, _default(record.config, key)), 24)}" for key in differing)
        for record, words in zip(records, chosen, strict=True)
    ]


def _label(settings: Iterable[str]) -> str:
    """Return the settings that fit into a name, and the number of the others."""
    words = list(settings)
    shown = words[:1]
    for word in words[1:_MOST_WORDS]:
        if len(" ".join([*shown, word])) > _MOST_LETTERS:
            break
        shown.append(word)
    return " ".join([*shown, *[f"and {len(words) - len(shown)} more"] * (len(words) > len(shown))])


def _overrides(run: Path) -> dict[str, str]:
    """Return the overrides of a run by key, without those irrelevant to its group."""
    file = run / OVERRIDES
    words = read_yaml(file, WRITTEN) if file.is_file() else []
    pairs = [str(word).partition("=") for word in words or ()]
    return {
        key.lstrip("+~"): value
        for key, _, value in pairs
        if key.partition(".")[0].lstrip("+~") not in _UNNAMED
    }


def _default(config: Mapping[str, Any], key: str) -> str:
    """Return the default value of a key, for a group its option."""
    value: Any = config
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    if isinstance(value, Mapping):
        value = value.get("name", "default")
    return value_text(value)


def courses_of(groups: Sequence[RunGroup]) -> list[str]:
    """Return all tracks of groups."""
    return list(dict.fromkeys(course for group in groups for course in group.courses))


_WORDS = {
    "lap_time_s": ("faster", "slower", "as fast", "a lap"),
    "laps_percent": ("surer", "less sure", "as sure", "of usual laps complete"),
    "held_out_completion": ("more robust", "less robust", "as robust", "of held-out completion"),
}
"""Words for better, worse and equal in the figures that a verdict names, and the unit of the amount."""
VERDICT = tuple(_WORDS)
_WITHOUT_LAP = {
    1: "faster: the other completes too few laps for a time",
    0: "neither completes enough laps for a time",
    -1: "slower: it completes too few laps for a time",
}


@dataclass(frozen=True)
class Comparison:
    """A figure of a group held against that of the first group."""

    group: str
    other: str
    course: str | None
    """The track; None for all tracks that both have, each in shares of its mean."""
    figure: str
    difference: Difference

    @property
    def verdict(self) -> str:
        """Return in words whether the groups differ."""
        better, worse, _, _ = _WORDS.get(self.figure, ("better", "worse", "", ""))
        return self.difference.verdict(better, worse)

    @property
    def words(self) -> str:
        """Return the difference in words: ``faster by 1.00 s a lap (0.83 to 1.11, not chance)``.

        With too few runs, chance is not mentioned.
        """
        better, worse, same, tail = _WORDS[self.figure]
        apart, lower_is_better = self.difference, FORMS[self.figure][2] < 0
        if apart.iqm is None:
            return _WITHOUT_LAP[(apart.probability > 0.5) - (apart.probability < 0.5)]
        form = "{:.1f}" if self.course is None else FORMS[self.figure][1]
        unit = "%" if self.course is None else " s" if self.figure == "lap_time_s" else " points"
        amount = form.format(abs(apart.iqm))
        gains = (apart.iqm < 0) == lower_is_better
        if not float(amount):
            return same
        words = f"{better if gains else worse} by {amount}{unit} {tail}"
        if not apart.enough:
            return words
        chance = "may be chance" if apart.explained_by_seeds else "not chance"
        if apart.interval is None:
            return f"{words} ({chance})"
        # In the direction of the word, so that an interval on both sides of zero has one negative end.
        low, high = apart.interval if apart.iqm > 0 else (-apart.interval[1], -apart.interval[0])
        return f"{words} ({form.format(low)} to {form.format(high)}, {chance})"


def compared(groups: Sequence[RunGroup]) -> list[Comparison]:
    """Compare each group with the first: on each common track, and on all of these together."""
    comparisons: list[Comparison] = []
    first, *others = groups
    for other in others:
        common = [course for course in first.courses if course in other.courses]
        for figure in FORMS:
            cells = []
            for course in common:
                pair = other.on(course).scores(figure), first.on(course).scores(figure)
                if len(pair[0]) and len(pair[1]):
                    cells.append((course, pair))
            for course, pair in cells:
                comparisons.append(_comparison(other, first, course, figure, [pair]))
            if len(cells) > 1:
                comparisons.append(
                    _comparison(other, first, None, figure, [_relative(pair) for _, pair in cells])
                )
    return comparisons


def _comparison(
    group: RunGroup, other: RunGroup, course: str | None, figure: str, pairs: Sequence[tuple[Values, Values]]
) -> Comparison:
    ours, theirs = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    lower_is_better = FORMS[figure][2] < 0
    return Comparison(group.name, other.name, course, figure, difference(ours, theirs, lower_is_better))


def _relative(pair: tuple[Values, Values]) -> tuple[Values, Values]:
    """Return scores as shares, per cent, of the interquartile mean of both: those of different tracks then compare."""
    together = np.concatenate(pair)
    finite = together[np.isfinite(together)]
    scale = float(interquartile_mean(finite)) if len(finite) else 0.0
    return (pair[0] / scale * 100, pair[1] / scale * 100) if scale else pair
