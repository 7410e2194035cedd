"""Reads recordings of trainings and races from folders, archives and single files, in all layouts of the service."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.errors import BadInput

from .deduplicate import (
    EPISODES_PER_ITERATION,
    Drives,
    Rows,
    checkpoint_number,
    concatenated,
    first_checkpoint,
    in_degrees,
    iterations_of,
    number_episodes,
    repeated,
    rows_also_in,
    steps_of,
)
from .log_archive import LogFile, Place, label, natural, place_of, same_job
from .recording import (
    METRICS_COLUMNS,
    TRAINING,
    UPDATE_COLUMNS,
    LogProblem,
    Recording,
    Round,
    readable,
    typed_table,
)
from .recording_parts import MetricsRows, Parts, iteration_in_name, read_parts
from .sim_trace import StepTables
from .training_log import TrainingLog, Update, join_rolled

_KINDS = (TRAINING, "evaluation", "leaderboard")
Root = tuple[str, ...]
Numbers = Mapping[tuple[int, int, int], int]
"""Number of an episode in the recording, by round, worker, and its number in the worker's own log."""


def read_recording(path: Path) -> Recording:
    """Read the recording in a file, in an archive or anywhere below a folder.

    Layouts are recognised: archives of the console and of DeepRacer on AWS, model folders of
    deepracer-for-cloud with one or several workers, uploaded models, single CSVs and text logs, rolled logs.
    Where the same steps are in a CSV and in a text log, those of the CSV are used: it has all digits.
    Several trainings follow one another, as rounds of clones.

    Raises:
        BadInput: there is nothing, or nothing that can be read.
    """
    parts = read_parts(path)
    name = path.resolve().name.removesuffix(".gz").removesuffix(".tar").removesuffix(".tgz")
    recording = _Assembly(parts).recording(readable(name))
    if not (len(recording.steps) or len(recording.updates) or len(recording.metrics)):
        why = f" ({recording.problems[0]})" if recording.problems else ""
        raise BadInput(f"{path}: no recorded steps{why}; accepted: trace CSVs or logs of the service")
    return recording


class _Assembly:
    """Joins the parts of a recording."""

    def __init__(self, parts: Parts) -> None:
        self.parts = parts
        self.problems = list(parts.problems)
        # Of several files of settings the one nearest to the top is used, files before logs.
        self.settings = _uppermost(parts.hyperparameters) or {}
        self.episodes_per_iteration = int(
            self.settings.get("num_episodes_between_training", EPISODES_PER_ITERATION)
        )
        self.logs = join_rolled(parts.logs)
        self.drives = [*self._drives_of_csv()]
        self.jobs: dict[Root, Root] = {}
        """Folder of the CSVs by the root of the text logs of the same training."""
        roots = [self._add_log(file, log) for file, log in self.logs]
        self.roots = [self.jobs.get(root, root) for root in roots]
        """Of each log, the root of its drives."""
        for one in self.drives:
            one.place = replace(one.place, root=self.jobs.get(one.place.root, one.place.root))
        self.copies: dict[Root, Drives] = {}
        """Copies of other trainings, by their folders."""
        self._drop_copies()
        self.training = [one for one in self.drives if one.place.kind == TRAINING]
        self.evaluations = self._named_evaluations()
        roots_found = {one.place.root for one in self.training} or {()}
        self.rounds = sorted(roots_found, key=lambda root: natural("/".join(root)))
        self.first: dict[int, tuple[int, int]] = {}
        """First iteration and first episode of each round."""
        self.numbers: Numbers = {}
        self.iteration_of: dict[int, int] = {}
        """Iteration of each training episode of the recording."""

    def recording(self, name: str) -> Recording:
        """Return the recording."""
        rows = [*self._training_rows(), *self._evaluation_rows()]
        parts = self.parts
        worlds = [one.world for one in self.training if one.world]
        rounds = [Round("/".join(self.rounds[number]), *begin) for number, begin in self.first.items()]
        return Recording(
            name=name,
            steps=steps_of(rows),
            updates=self._updates(),
            metrics=self._metrics(),
            metadata=_uppermost(parts.metadata),
            hyperparameters=self.settings or None,
            reward_source=_uppermost(parts.reward),
            track=worlds[0] if worlds else parts.worlds.get(TRAINING),
            problems=tuple(self.problems),
            files=tuple(parts.files),
            checkpoints=self._checkpoints(),
            rounds=tuple(rounds) if len(rounds) > 1 else (),
        )

    def _leave_out(self, file: str, count: int, reason: str) -> None:
        self.problems.append(LogProblem(file, None, f"{count} {reason}", lines=count))

    def _drives_of_csv(self) -> Iterable[Drives]:
        groups: dict[Place, list[tuple[LogFile, StepTables]]] = {}
        for file, steps in self.parts.traces:
            place = place_of(file.parts)
            if place.kind == TRAINING:
                place = replace(place, name=place.root[-1] if place.root else TRAINING)
            groups.setdefault(place, []).append((file, steps))
        for place, traces in groups.items():
            traces.sort(
                key=lambda one: (-1 if (at := iteration_in_name(one[0])) is None else at, one[0].order)
            )
            tables, iterations = [], []
            for file, steps in traces:
                number = iteration_in_name(file)
                tables.append(in_degrees(steps.whole))
                counted = tables[-1]["episode"].to_numpy().astype(np.int64) // self.episodes_per_iteration
                iterations.append(counted if number is None else np.full_like(counted, number))
            world = self.parts.worlds.get(place.kind, "")
            yield Drives(place, concatenated(tables), np.concatenate(iterations), world, [place.name])

    def _add_log(self, file: LogFile, log: TrainingLog) -> Root:
        """Add the drives of a log, or its names to the drives of CSVs with the same steps; return their root."""
        place = place_of(file.parts)
        if place.kind == TRAINING:
            name = place.name.replace(str(place.worker), "#") if place.worker else place.name
            if log.job:
                # All workers of a job began with the same checkpoint; the next job in the same folder with another.
                name = f"{log.job}, {first_checkpoint(log)}"
            worker = place.worker if log.worker is None else log.worker
            place = replace(place, root=(*place.root, name), worker=worker)
        if not log.steps.rows:
            return place.root
        settings = log.hyperparameters or {}
        per_iteration = settings.get("num_episodes_between_training")
        if not isinstance(per_iteration, int) or per_iteration < 1:
            per_iteration = self.episodes_per_iteration
        table = in_degrees(concatenated([log.steps.whole]))
        mine = Drives(place, table, iterations_of(table, log, per_iteration), log.world or "", [place.name])
        if place.kind != TRAINING:
            mine.iteration[:] = 0
        left = np.ones(len(mine.iteration), np.bool_)
        root = place.root
        for other in self.drives:
            same = rows_also_in(mine, other)
            if same.any():
                if left.all():  # of copies the first counts
                    root = other.place.root
                    if place.kind == TRAINING:
                        self.jobs[place.root] = root
                left &= ~same
                other.world = log.world or other.world
                other.names.append(place.name)
        if left.all():
            mine.world = mine.world or self.parts.worlds.get(place.kind, "")
            self.drives.append(mine)
        elif left.any():
            episodes = table["episode"].to_numpy()[left]
            reason = (
                f"steps of episodes {episodes.min()} to {episodes.max()} are left out: they are in the log only, not "
                "in the CSVs of the same training"
            )
            self._leave_out(str(file.path), len(episodes), reason)
        return root

    def _drop_copies(self) -> None:
        """Leave out drives and rows that are there twice, as with a copy of a folder or a file."""
        known: dict[tuple[str, bytes, bytes], Drives] = {}
        for one in list(self.drives):
            folder = "/".join(one.place.root)
            times = one.table["tstamp"].to_numpy()
            first = known.setdefault((one.place.kind, one.key.tobytes(), times.tobytes()), one)
            if first is not one and len(times):
                reason = f"steps are left out: copies of {'/'.join(first.place.root)}"
                self._leave_out(folder, len(times), reason)
                self.drives.remove(one)
                self.copies[one.place.root] = one
                continue
            twice = repeated(one)
            if twice.any():
                self._leave_out(folder, int(twice.sum()), "rows are left out: they are there twice")
                self.drives[self.drives.index(one)] = one.choose(~twice)

    def _training_rows(self) -> Iterable[Rows]:
        """Yield the rows of the training, and number its rounds, iterations and episodes."""
        place = {root: number for number, root in enumerate(self.rounds)}
        drives = sorted(self.training, key=lambda one: (place[one.place.root], one.place.worker))
        if not drives:
            return
        rounds = np.concatenate([np.full(len(one.iteration), place[one.place.root]) for one in drives])
        worker = np.concatenate([np.full(len(one.iteration), one.place.worker) for one in drives])
        iteration = np.concatenate([one.iteration for one in drives])
        table = concatenated([one.table for one in drives])
        if len(drives) > 1:
            # The rows of several workers are put in the order of iterations.
            order = np.lexsort((worker, iteration, rounds))
            table = table.take(order)
            rounds, worker, iteration = rounds[order], worker[order], iteration[order]
        raw, steps = (table[name].to_numpy().astype(np.int64) for name in ("episode", "steps"))
        episode, self.numbers = number_episodes(rounds, worker, raw, iteration, steps)
        so_far = 0
        for number in np.unique(rounds).tolist():
            of = rounds == number
            # An iteration has the number of the checkpoint that drove it, unless an earlier round has used it.
            so_far = max(so_far, self._base(number))
            iteration[of] += so_far
            self.first[number] = (so_far, int(episode[of].min()))
            so_far = int(iteration[of].max()) + 1
        self.iteration_of = dict(zip(episode.tolist(), iteration.tolist(), strict=True))
        worlds = [
            next((one.world for one in drives if one.place.root == root and one.world), "")
            for root in self.rounds
        ]
        yield Rows(TRAINING, table, worker, iteration, episode, worlds, rounds)

    def _logs_of(self, number: int) -> list[TrainingLog]:
        """Return the logs of a round that name its checkpoints."""
        found = []
        for (file, log), root in zip(self.logs, self.roots, strict=True):
            drove = log.checkpoints and log.steps.rows and place_of(file.parts).kind == TRAINING
            if (log.saved or drove) and self._round(file, root) == number:
                found.append(log)
        return found

    def _base(self, number: int) -> int:
        """Return the number of the checkpoint that drove a round's first iteration."""
        return max(map(first_checkpoint, self._logs_of(number)), default=0)

    def _checkpoints(self) -> dict[int, str]:
        """Return the names of checkpoints by the iteration that they drove."""
        found: dict[int, str] = {}
        for number, (begin, _) in self.first.items():
            base = self._base(number)
            for log in self._logs_of(number):
                for name in (*log.saved, *(name for _, name in log.checkpoints)):
                    if checkpoint_number(name) >= base:  # a clone's log names its parent, too
                        found[checkpoint_number(name) - base + begin] = name
        return dict(sorted(found.items()))

    def _evaluation_rows(self) -> Iterable[Rows]:
        for name, one in self.evaluations.items():
            raw, steps = (one.table[key].to_numpy().astype(np.int64) for key in ("episode", "steps"))
            none = np.zeros_like(raw)
            episode, _ = number_episodes(none, none, raw, none, steps)
            yield Rows(name, one.table, none, one.iteration, episode, [one.world], none)

    def _named_evaluations(self) -> dict[str, Drives]:
        """Return evaluations and races by their unique names, in chronological order."""
        drives = [one for one in self.drives if one.place.kind != TRAINING]
        drives.sort(key=lambda one: (_KINDS.index(one.place.kind), natural(one.place.name)))
        named: dict[str, Drives] = {}
        for one in drives:
            name = one.place.name if one.place.name != TRAINING else "evaluation"
            if name in named:
                name = "/".join((*one.place.root[-2:], name))
            while name in named:
                name += "+"
            named[name] = one
        return named

    def _updates(self) -> pd.DataFrame:
        rows: dict[tuple[int, int], dict[str, Any]] = {}
        for (file, log), root in zip(self.logs, self.roots, strict=True):
            of = self._round(file, root) if log.updates else None
            if of is None:
                continue
            if self.first and of not in self.first:
                reason = "policy updates are left out, as their steps are"
                self._leave_out(str(file.path), len(log.updates), reason)
                continue
            begin, _ = self.first.get(of, (0, 0))
            for iteration, update in zip(_iterations(log.updates), log.updates, strict=True):
                row = {"iteration": begin + iteration, "value_loss": np.nan, **update._asdict()}
                rows.setdefault((row["iteration"], update.epoch), row)
        return typed_table(UPDATE_COLUMNS, [rows[key] for key in sorted(rows)])

    def _round(self, file: LogFile, root: Root) -> int | None:
        """Return the round that a file belongs to, by its drives, its name, or its folder; None: to a copy."""
        if root in self.copies:
            return None
        if root in self.rounds or (len(self.rounds) == 1 and not self.copies):
            return self.rounds.index(root) if root in self.rounds else 0
        names: dict[Root, list[str]] = {}
        for one in (*self.training, *self.copies.values()):
            names.setdefault(one.place.root, []).extend(one.names)

        def nearness(of: Root) -> tuple[bool, int]:
            common = next(
                (at for at, (a, b) in enumerate(zip(of, file.parts, strict=False)) if a != b), len(of)
            )
            return any(same_job(file.name, known) for known in names.get(of, ())), common

        nearest = max((*self.rounds, *self.copies), key=nearness)
        return self.rounds.index(nearest) if nearest in self.rounds else None

    def _metrics(self) -> pd.DataFrame:
        rows: MetricsRows = []
        evaluated: set[tuple[str, str]] = set()
        for file, episodes in self.parts.metrics:
            if episodes and _of_training(file, episodes):
                rows += self._training_metrics(file, episodes)
            elif episodes:
                names = [
                    name
                    for name, one in self.evaluations.items()
                    if any(same_job(file.name, known) for known in one.names)
                ]
                stream = names[0] if names else label(file.name)
                # A copy of another evaluation's folder has the same rows.
                if (stream, repr(episodes)) not in evaluated:
                    rows += [{**row, "stream": stream, "worker": 0, "iteration": 0} for row in episodes]
                evaluated.add((stream, repr(episodes)))
        rows.sort(key=lambda row: (0, row["episode"]) if row["stream"] == TRAINING else (1, 0))
        return typed_table(METRICS_COLUMNS, rows)

    def _training_metrics(self, file: LogFile, episodes: MetricsRows) -> MetricsRows:
        """Return the rows of a training's metrics, with the numbers of the recording."""
        worker, number = place_of(file.parts).worker, self._round(file, ())
        if number is None:
            return []
        keys = [(number, worker, row["episode"]) for row in episodes]
        counted = _iterations_by_trial(episodes)
        known = [
            self.iteration_of[self.numbers[key]] - at
            for row, key, at in zip(episodes, keys, counted, strict=True)
            if row["phase"] == TRAINING and key in self.numbers
        ]
        shift = int(np.median(known)) if known else self.first.get(number, (0, 0))[0]
        dropped = any(steps.left_out for _, steps in self.parts.steps())
        begin = min((own for *of, own in self.numbers if of == [number, worker]), default=math.inf)
        rows = [
            {
                **row,
                "stream": TRAINING,
                "worker": worker,
                "iteration": at + shift,
                "episode": self.numbers[key] if key in self.numbers else _behind(self.numbers, key),
            }
            for row, key, at in zip(episodes, keys, counted, strict=True)
            if not dropped or row["episode"] >= begin
        ]
        if len(rows) < len(episodes):
            reason = "episodes are left out, as their steps are"
            self._leave_out(str(file.path), len(episodes) - len(rows), reason)
        return rows


def _iterations_by_trial(rows: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the iteration of each episode of a metrics file, from 0: its trials are counted from 1."""
    found: list[int] = []
    iteration, trial = 0, 0
    for row in rows:
        if row["phase"] == TRAINING:
            iteration += row["trial"] <= trial
            trial = row["trial"]
        found.append(iteration)
    return found


def _behind(numbers: Numbers, key: tuple[int, int, int]) -> int:
    """Return a number for an episode without rows: as far behind its worker's last one as in the file."""
    mine = [(own, number) for (of, worker, own), number in numbers.items() if (of, worker) == key[:2]]
    if not mine:
        return key[2]
    own, _ = max(mine)
    same = all(own == number for own, number in mine)
    return key[2] if same else max(numbers.values()) + max(1, key[2] - own)


def _of_training(file: LogFile, episodes: MetricsRows) -> bool:
    name = file.name.lower()
    if "training" in name or "evaluation" in name:
        return name.rfind("training") > name.rfind("evaluation")
    return any(row["phase"] == TRAINING for row in episodes)


def _iterations(updates: Sequence[Update]) -> list[int]:
    """Return the iteration of each update: that of the episodes before it, or one more than the last."""
    found: list[int] = []
    for number, update in enumerate(updates):
        last = updates[number - 1] if number else None
        if last is None:
            found.append(update.logged_iteration or 0)
        elif update.epoch > last.epoch and update.logged_iteration in (last.logged_iteration, None):
            found.append(found[-1])
        else:
            found.append(
                max(-1 if update.logged_iteration is None else update.logged_iteration, found[-1] + 1)
            )
    return found


def _uppermost(found: Sequence[tuple[LogFile, Any]]) -> Any:
    """Return the content of the file nearest to the top; settings precede logs, a training's precede others."""

    def rank(one: tuple[LogFile, Any]) -> tuple[bool, bool, int]:
        parts = one[0].parts
        return not one[0].name.endswith((".json", ".py")), place_of(parts).kind != TRAINING, len(parts)

    return min(found, key=rank)[1] if found else None
