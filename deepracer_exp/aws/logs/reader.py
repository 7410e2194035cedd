"""Reads recordings of trainings and races from folders, archives and single files, in all layouts of the service."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.aws.archives import natural
from deepracer_exp.errors import BadInput

from .drives import (
    Drives,
    Rows,
    concatenated,
    first_checkpoint,
    logged_number,
    number_episodes,
    steps_of,
)
from .joining import JoinedSteps, log_place, uppermost
from .log_files import PACKED, LogFile, label, log_folder, named_parts, place_of, same_job
from .parts import Parts, read_parts
from .recorded import (
    CHECKPOINT,
    METRICS_COLUMNS,
    TRAINING,
    UPDATE_COLUMNS,
    LogProblem,
    Recording,
    Round,
    readable,
    typed_table,
)
from .text_log import TrainingLog, Update

_KINDS = (TRAINING, "evaluation", "leaderboard")
Numbers = Mapping[tuple[int, int, int], int]


def read_recording(path: Path) -> Recording:
    """Read the recording in a file, an archive or a folder at any depth.

    Layouts are recognised: archives of the console and of DeepRacer on AWS, model folders of
    deepracer-for-cloud with one or several workers, uploaded models, single CSVs and text logs, rolled logs.
    Where the same steps are in a CSV and in a text log, those of the CSV are used: it has all digits.
    Several trainings follow one another, as rounds of clones.

    Raises:
        BadInput: there is nothing, or nothing that can be read.
    """
    with log_folder(path) as folder:
        parts = read_parts(folder)
    name = PACKED.sub("", named_parts(path)[-1])
    recording = _Assembly(parts).recording(readable(name))
    if not (len(recording.steps) or len(recording.updates) or len(recording.metrics)):
        why = f" ({recording.problems[0]})" if recording.problems else ""
        raise BadInput(path, f"no recorded steps{why}", "trace CSVs or logs of the service")
    return recording


def _steps_before(steps: pd.DataFrame) -> list[int]:
    """Return the control steps of a training before each iteration and after the last, while all are recorded."""
    episodes = steps.groupby("episode").agg(
        iteration=("iteration", "last"), rows=("steps", "size"), last=("steps", "max")
    )
    episodes["whole"] = (episodes["rows"] == episodes["last"]) & (episodes.index == np.arange(len(episodes)))
    iterations = episodes.groupby("iteration").agg({"rows": "sum", "whole": "all"})
    whole = (iterations["whole"] & (iterations.index == np.arange(len(iterations)))).cummin()
    return [0, *iterations["rows"].cumsum()[whole]] if 0 in iterations.index else []


def _counted_checkpoints(before: Sequence[int], last: str) -> dict[int, str]:
    """Return the names of the checkpoints that drove iterations, by the control steps `before` each.

    The service numbers checkpoints, and a clone's continue those of its parent: `last` is the name of the last one in
    the model's folder, "" if there is none. Without that step among those counted, the count is not the model's.
    """
    base, match = 0, CHECKPOINT.match(last)
    if match is not None:
        number, driven = map(int, match.groups())
        base = number - before.index(driven) if driven in before else -1
    return {} if base < 0 else {k: f"{base + k}_Step-{driven}" for k, driven in enumerate(before)}


class _Assembly:
    """Numbers the rounds, iterations and episodes of a recording, and puts its tables together."""

    def __init__(self, parts: Parts) -> None:
        joined = JoinedSteps(parts)
        self.parts, self.problems, self.settings = parts, joined.problems, joined.settings
        self.logs, self.drives = joined.logs, joined.drives
        self.roots, self.copies = joined.roots, joined.copies
        self.iteration_of: dict[int, int] = {}
        """Iteration of each training episode of the recording."""
        self.training = [drives for drives in self.drives if drives.place.kind == TRAINING]
        self.rounds = sorted(
            {drives.place.root for drives in self.training}, key=lambda root: natural("/".join(root))
        )
        if not self.rounds:
            self.rounds = [()]

    def recording(self, name: str) -> Recording:
        """Return the recording."""
        rows, numbers, first = self._training_rows()
        parts = self.parts
        worlds = [drives.world for drives in self.training if drives.world]
        rounds = [
            Round("/".join(root), first[number]) for number, root in enumerate(self.rounds) if number in first
        ]
        steps = steps_of([*rows, *self._evaluation_rows()])
        stored = uppermost(parts.model_checkpoints) or {}
        named = self._checkpoints(first)
        counted = {}
        if len(rounds) <= 1:
            counted = _counted_checkpoints(
                _steps_before(steps[steps["stream"] == TRAINING]),
                "" if named else stored.get("last_checkpoint", ""),
            )
        if any(counted.get(key, text) != text for key, text in named.items()):
            counted = {}
        return Recording(
            name=name,
            steps=steps,
            updates=self._updates(first),
            metrics=self._metrics(numbers, first),
            metadata=uppermost(parts.metadata),
            hyperparameters=self.settings or None,
            reward_source=uppermost(parts.reward),
            track=worlds[0] if worlds else parts.world(TRAINING, 0) or None,
            problems=tuple(self.problems),
            files=tuple(file.path for file in parts.files),
            checkpoints=dict(sorted((counted | named).items())),
            checkpoints_counted=bool(counted) and not named and not stored,
            model_checkpoints=stored,
            rounds=tuple(rounds) if len(rounds) > 1 else (),
            race=parts.races[TRAINING] if TRAINING in parts.races else next(iter(parts.races.values()), {}),
        )

    def _training_rows(self) -> tuple[list[Rows], Numbers, dict[int, int]]:
        """Return the rows, the numbers of the episodes, and the first iteration of each round."""
        place = {root: number for number, root in enumerate(self.rounds)}
        drives = sorted(self.training, key=lambda part: (place[part.place.root], part.place.worker))
        if not drives:
            return [], {}, {}
        rounds = np.concatenate([np.full(len(part.iteration), place[part.place.root]) for part in drives])
        worker = np.concatenate([np.full(len(part.iteration), part.place.worker) for part in drives])
        iteration = np.concatenate([part.iteration for part in drives])
        # Each worker may drive on a track of its own; one that names none drives where its round does.
        of_round = {part.place.root: part.world for part in reversed(drives) if part.world}
        worlds = [part.world or of_round.get(part.place.root, "") for part in drives]
        track = np.repeat(np.arange(len(drives)), [len(part.iteration) for part in drives])
        table = concatenated([part.table for part in drives])
        if len(drives) > 1:
            # The rows of several workers are put in the order of iterations.
            order = np.lexsort((worker, iteration, rounds))
            table = table.take(order)
            rounds, worker, iteration, track = rounds[order], worker[order], iteration[order], track[order]
        raw, steps = (table[name].to_numpy().astype(np.int64) for name in ("episode", "steps"))
        episode, numbers = number_episodes(rounds, worker, raw, iteration, steps)
        first: dict[int, int] = {}
        so_far = 0
        for number in np.unique(rounds).tolist():
            of = rounds == number
            # An iteration has the number of the checkpoint that drove it, unless an earlier round has used it.
            so_far = max(so_far, self._base(number))
            iteration[of] += so_far
            first[number] = so_far
            so_far = int(iteration[of].max()) + 1
        self.iteration_of = dict(zip(episode.tolist(), iteration.tolist(), strict=True))
        return [Rows(TRAINING, table, worker, iteration, episode, worlds, track)], numbers, first

    def _logs_of(self, number: int) -> list[TrainingLog]:
        """Return the logs of a round that name its checkpoints."""
        return [
            log
            for index, (files, log) in enumerate(self.logs)
            if (log.saved or (log.checkpoints and log.steps.rows and log_place(files, log).kind == TRAINING))
            and self._round(files[0], self.roots[index]) == number
        ]

    def _base(self, number: int) -> int:
        """Return the number of the checkpoint that drove a round's first iteration."""
        return max(map(first_checkpoint, self._logs_of(number)), default=0)

    def _checkpoints(self, first: Mapping[int, int]) -> dict[int, str]:
        """Return the names of checkpoints by the iteration that they drove."""
        names: dict[int, str] = {}
        for number, begin in first.items():
            base = self._base(number)
            for log in self._logs_of(number):
                for name in (*log.saved, *(name for _, name in log.checkpoints)):
                    if logged_number(name) >= base:  # a clone's log names its parent, too
                        names[logged_number(name) - base + begin] = name
        return names

    def _evaluation_rows(self) -> list[Rows]:
        parts = []
        for name, drives in self._evaluations().items():
            raw, steps = (drives.table[key].to_numpy().astype(np.int64) for key in ("episode", "steps"))
            none = np.zeros_like(raw)
            episode, _ = number_episodes(none, none, raw, none, steps)
            parts.append(Rows(name, drives.table, none, drives.iteration, episode, [drives.world], none))
        return parts

    def _evaluations(self) -> dict[str, Drives]:
        """Return evaluations and races by their unique names, in chronological order."""
        drives = [race for race in self.drives if race.place.kind != TRAINING]
        drives.sort(key=lambda race: (_KINDS.index(race.place.kind), natural(race.place.name)))
        named: dict[str, Drives] = {}
        for race in drives:
            name = race.place.name if race.place.name != TRAINING else "evaluation"
            if name in named:
                name = "/".join((*race.place.root[-2:], name))
            while name in named:
                name += "+"
            named[name] = race
        return named

    def _updates(self, first: Mapping[int, int]) -> pd.DataFrame:
        rows: dict[tuple[int, int], dict[str, Any]] = {}
        for number, (files, log) in enumerate(self.logs):
            if not log.updates:
                continue
            of = self._round(files[0], self.roots[number])
            if of is None:
                continue
            if first and of not in first:
                self._leave_out(files[0], "policy updates", len(log.updates))
                continue
            begin = first.get(of, 0)
            for iteration, update in zip(_iterations(log.updates), log.updates, strict=True):
                row = {"iteration": begin + iteration, "value_loss": np.nan, **update._asdict()}
                rows.setdefault((row["iteration"], update.epoch), row)
        return typed_table(UPDATE_COLUMNS, [rows[key] for key in sorted(rows)])

    def _round(self, file: LogFile, root: tuple[str, ...]) -> int | None:
        """Return the round that a file belongs to, by its drives, its name, or its folder; None: to a copy."""
        if root in self.copies:
            return None
        if root in self.rounds or (len(self.rounds) == 1 and not self.copies):
            return self.rounds.index(root) if root in self.rounds else 0
        names: dict[tuple[str, ...], list[str]] = {}
        for drives in (*self.training, *self.copies.values()):
            names.setdefault(drives.place.root, []).extend(drives.names)

        def nearness(of: tuple[str, ...]) -> tuple[bool, int]:
            common = next(
                (depth for depth, (a, b) in enumerate(zip(of, file.parts, strict=False)) if a != b), len(of)
            )
            return any(same_job(file.name, name) for name in names.get(of, ())), common

        nearest = max((*self.rounds, *self.copies), key=nearness)
        return self.rounds.index(nearest) if nearest in self.rounds else None

    def _leave_out(self, file: LogFile, what: str, count: int) -> None:
        """Report data about steps that are left out."""
        reason = f"{count} {what} are left out, as their steps are"
        self.problems.append(LogProblem(str(file.path), None, reason, lines=count))

    def _metrics(self, numbers: Numbers, first: Mapping[int, int]) -> pd.DataFrame:
        rows: list[dict[str, Any]] = []
        evaluated: set[tuple[str, str]] = set()
        begins: dict[tuple[int, int], int] = {}
        for of, own_worker, logged in numbers if self.parts.left_out else ():
            begins[of, own_worker] = min(logged, begins.get((of, own_worker), logged))
        evaluations = self._evaluations()
        for file, episodes in self.parts.metrics:
            if not episodes:
                continue
            if _of_training(file, episodes):
                worker, number = place_of(file.parts).worker, self._round(file, ())
                if number is None:
                    continue
                begin = begins.get((number, worker), math.inf if begins else 0)
                gone = sum(row["episode"] < begin for row in episodes)
                if gone:
                    self._leave_out(file, "episodes", gone)
                counted = _iterations_by_trial(episodes)
                keys = [(number, worker, row["episode"]) for row in episodes]
                # Trials say where an iteration begins; its number is that of the traced episode before.
                traced = [
                    self.iteration_of[numbers[key]] - index
                    if row["phase"] == TRAINING and key in numbers
                    else np.nan
                    for row, index, key in zip(episodes, counted, keys, strict=True)
                ]
                shifts = pd.Series(traced).ffill().bfill().fillna(first.get(number, 0)).astype(int)
                for row, index, key, shift in zip(episodes, counted, keys, shifts, strict=True):
                    if row["episode"] < begin:
                        continue
                    episode = numbers.get(key)
                    if episode is None:
                        episode = _behind(numbers, key)
                    own_row = {"stream": TRAINING, "worker": worker, "iteration": index + shift}
                    rows.append({**row, **own_row, "episode": episode})
            else:
                stream = label(file.name)
                for name, drives in evaluations.items():
                    if any(same_job(file.name, job) for job in drives.names):
                        stream = name
                        break
                # A copy of another evaluation's folder.
                if (stream, repr(episodes)) in evaluated:
                    continue
                evaluated.add((stream, repr(episodes)))
                rows += [{**row, "stream": stream, "worker": 0, "iteration": 0} for row in episodes]
        rows.sort(key=lambda row: (0, row["episode"]) if row["stream"] == TRAINING else (1, 0))
        return typed_table(METRICS_COLUMNS, rows)


def _iterations_by_trial(rows: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the iteration of each episode of a metrics file, from 0: its trials are counted from 1."""
    iterations: list[int] = []
    iteration, trial = 0, 0
    for row in rows:
        if row["phase"] == TRAINING:
            iteration += row["trial"] <= trial
            trial = row["trial"]
        iterations.append(iteration)
    return iterations


def _behind(numbers: Numbers, key: tuple[int, int, int]) -> int:
    """Return a number for an episode without rows: as far after its worker's last one as in the metrics file."""
    mine = [(logged, number) for (of, worker, logged), number in numbers.items() if (of, worker) == key[:2]]
    if not mine:
        return key[2]
    last, _ = max(mine)
    same = all(logged == number for logged, number in mine)
    return key[2] if same else max(numbers.values()) + max(1, key[2] - last)


def _of_training(file: LogFile, episodes: Sequence[Mapping[str, Any]]) -> bool:
    name = file.name.lower()
    if "training" in name or "evaluation" in name:
        return name.rfind("training") > name.rfind("evaluation")
    return any(row["phase"] == TRAINING for row in episodes)


def _iterations(updates: Sequence[Update]) -> list[int]:
    """Return the iteration of each update: that of the episodes before it, or one more than the last."""
    iterations: list[int] = []
    for number, update in enumerate(updates):
        last = updates[number - 1] if number else None
        if last is None:
            iterations.append(update.logged_iteration or 0)
        elif update.epoch > last.epoch and update.logged_iteration in (last.logged_iteration, None):
            iterations.append(iterations[-1])
        else:
            iterations.append(
                max(-1 if update.logged_iteration is None else update.logged_iteration, iterations[-1] + 1)
            )
    return iterations
