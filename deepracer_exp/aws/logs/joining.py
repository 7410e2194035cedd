"""Joins and deduplicates the steps of all files of a recording: CSVs, logs, and copies of them."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from deepracer_exp.aws.archives import natural
from deepracer_exp.aws.worlds.routes import recognise

from .drives import (
    EPISODES_PER_ITERATION,
    Drives,
    concatenated,
    first_checkpoint,
    in_degrees,
    iterations_of,
    repeated,
    rows_also_in,
)
from .log_files import LogFile, Place, place_of, without_worker
from .parts import Parts, TraceFile
from .recorded import TRAINING, LogProblem
from .text_log import TrainingLog, join_rolled

_SAME_LENGTH_M = 0.01
"""Lengths of one world that were logged with more and with fewer digits differ by less."""
_SAMPLE = 500
"""Rows that are enough to recognise a world."""


class JoinedSteps:
    """The drives of a recording, each once.

    Attributes:
        problems: omissions and their reasons.
        settings: hyperparameters of the training, empty where no file has them.
        logs: text logs with the files that each was in.
        drives: trainings and races with their rows.
        roots: folder of the training that a text log belongs to, by the log's index.
        copies: copies of other trainings, by their folders.
    """

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self.problems = list(parts.problems)
        # Of several files of settings the one nearest to the top is used, files before logs.
        self.settings = uppermost(parts.hyperparameters) or {}
        self.logs = join_rolled(parts.logs)
        self.drives = list(self._drives_of_csv())
        self.roots: dict[int, tuple[str, ...]] = {}
        self._jobs: dict[tuple[str, ...], tuple[str, ...]] = {}
        """Folder of the CSVs by the root of the text logs of the same training."""
        self.copies: dict[tuple[str, ...], Drives] = {}
        # A log of 2019 repeats lines of the training's under the name of an evaluation.
        for number in sorted(
            range(len(self.logs)), key=lambda index: log_place(*self.logs[index]).kind != TRAINING
        ):
            self._add_log(number, *self.logs[number])
        self._name_worlds()
        for drives in self.drives:
            drives.place = replace(drives.place, root=self._jobs.get(drives.place.root, drives.place.root))
        self.roots = {number: self._jobs.get(root, root) for number, root in self.roots.items()}
        self._without_copies()
        self._without_repeats()

    @property
    def _per_iteration(self) -> int:
        return int(self.settings.get("num_episodes_between_training", EPISODES_PER_ITERATION))

    def _drives_of_csv(self) -> Iterable[Drives]:
        groups: dict[Place, list[TraceFile]] = {}
        for trace in self._parts.traces:
            place = trace.place
            if place.kind == TRAINING:
                place = replace(place, name=place.root[-1] if place.root else TRAINING)
            groups.setdefault(place, []).append(trace)
        for place, traces in groups.items():
            traces.sort(key=lambda trace: (-1 if trace.number is None else trace.number, trace.file.order))
            tables = [in_degrees(trace.steps.whole) for trace in traces]
            iterations = [
                table["episode"].to_numpy().astype(np.int64) // self._per_iteration
                if trace.number is None
                else np.full(len(table), trace.number, np.int64)
                for trace, table in zip(traces, tables, strict=True)
            ]
            yield Drives(place, concatenated(tables), np.concatenate(iterations), names=[place.name])

    def _name_worlds(self) -> None:
        """Take worlds that no log names from the files of parameters, which have that of the last race only."""
        last_m: dict[str, Any] = {}
        for drives in sorted(self.drives, key=lambda drives: natural(drives.place.name), reverse=True):
            kind, length_m = drives.place.kind, drives.table["track_len"].to_numpy()[:1]
            if kind != TRAINING:
                last_m.setdefault(kind, length_m)
            world = self._parts.world(kind, drives.place.worker)
            if drives.world or not world:
                continue
            if np.allclose(length_m, last_m.get(kind, length_m), atol=_SAME_LENGTH_M):
                drives.world = world
            else:
                drives.world = _world_of(drives)

    def _add_log(self, number: int, files: Sequence[LogFile], log: TrainingLog) -> None:
        """Add the drives of a log, unless they are known already from CSVs or another log."""
        file, place = files[0], log_place(files, log)
        if place.kind == TRAINING:
            name = without_worker(place.name)
            if log.job:
                # All workers of a job began with the same checkpoint; the next job in the same folder with another.
                name = f"{log.job}, {first_checkpoint(log)}"
            worker = place.worker if log.worker is None else log.worker
            place = replace(place, root=(*place.root, name), worker=worker)
        job = place.root
        self.roots[number] = place.root
        if not log.steps.rows:
            return
        settings = log.hyperparameters or {}
        per_iteration = settings.get("num_episodes_between_training", self._per_iteration)
        whole = per_iteration if isinstance(per_iteration, int) and per_iteration > 0 else self._per_iteration
        table = in_degrees(concatenated([log.steps.whole]))
        mine = Drives(place, table, iterations_of(table, log, whole), log.world or "", [place.name])
        if place.kind != TRAINING:
            mine.iteration[:] = 0
        left, alike = np.ones(len(mine.iteration), np.bool_), False
        for other in self.drives:
            same = rows_also_in(mine, other)
            if same.any():
                if left.all() and other.place.kind == place.kind:  # of copies the first counts
                    alike = True
                    self.roots[number] = other.place.root
                    if place.kind == TRAINING:
                        self._jobs[job] = other.place.root
                left &= ~same
                other.world = log.world or other.world
                other.names.append(place.name)
        if left.all():
            self.drives.append(mine)
        elif left.any() and not alike:
            self.drives.append(mine.choose(left))
        elif left.any():
            self._add_rest(file, mine.choose(left), self.roots[number])

    def _add_rest(self, file: LogFile, rest: Drives, root: tuple[str, ...]) -> None:
        """Add the iterations that only the log contains: the service writes no CSV of a job's last one."""
        others = [
            part for part in self.drives if (part.place.root, part.place.kind) == (root, rest.place.kind)
        ]
        present = np.unique(np.concatenate([drives.iteration for drives in others]))
        whole = ~np.isin(rest.iteration, present)
        if rest.place.kind == TRAINING and whole.any():
            more, into = rest.choose(whole), others[0]
            iteration = np.concatenate([into.iteration, more.iteration])
            order = np.argsort(iteration, kind="stable")
            table = concatenated([into.table, more.table]).take(order)
            whole_drives = Drives(into.place, table, iteration[order], into.world, into.names)
            self.drives[self.drives.index(into)] = whole_drives
            rest = rest.choose(~whole)
        if rest.table.num_rows:
            episodes = rest.table["episode"].to_numpy()
            reason = (
                f"{rest.table.num_rows} steps of episodes {episodes.min()} to {episodes.max()} are left out: they are "
                "in the log only, not in the CSVs of the same training"
            )
            self.problems.append(LogProblem(str(file.path), None, reason, lines=rest.table.num_rows))

    def _without_copies(self) -> None:
        """Leave out drives that occur twice, as with a copy of a folder."""
        seen: dict[tuple[str, bytes, bytes], Drives] = {}
        for drives in list(self.drives):
            times = drives.table["tstamp"].to_numpy()
            first = seen.setdefault((drives.place.kind, drives.key.tobytes(), times.tobytes()), drives)
            if first is not drives and len(times):
                reason = f"{len(times)} steps are left out: copies of {'/'.join(first.place.root)}"
                self.problems.append(LogProblem("/".join(drives.place.root), None, reason, lines=len(times)))
                self.drives.remove(drives)
                self.copies[drives.place.root] = drives

    def _without_repeats(self) -> None:
        for number, drives in enumerate(self.drives):
            twice = repeated(drives)
            if twice.any():
                count = int(twice.sum())
                reason = f"{count} rows are left out: they are there twice"
                self.problems.append(LogProblem("/".join(drives.place.root), None, reason, lines=count))
                self.drives[number] = drives.choose(~twice)


def _world_of(drives: Drives) -> str:
    """Return the world whose waypoints are numbered as in the rows, "" if there is none."""
    rows = drives.table.select(["X", "Y", "closest_waypoint"]).to_pandas()
    rows = rows[np.isfinite(rows).all(axis=1) & (rows["closest_waypoint"] >= 0)]
    rows = rows.iloc[:: max(1, len(rows) // _SAMPLE)]
    if rows.empty:
        return ""
    matches = recognise(rows[["X", "Y"]].to_numpy(), rows["closest_waypoint"].to_numpy(np.intp))
    return matches[0].name if matches else ""


def log_place(files: Sequence[LogFile], log: TrainingLog) -> Place:
    """Return the job of a log, by its name, or by its settings where the name says nothing of a race."""
    place = place_of(files[0].parts)
    return replace(place, kind=log.kind, worker=0) if log.kind and place.kind == TRAINING else place


def uppermost(files: Sequence[tuple[LogFile, Any]]) -> Any:
    """Return the content of the file nearest to the top; settings precede logs, a training's precede others."""

    def rank(entry: tuple[LogFile, Any]) -> tuple[bool, bool, int]:
        parts = entry[0].parts
        return not entry[0].name.endswith((".json", ".py")), place_of(parts).kind != TRAINING, len(parts)

    return min(files, key=rank)[1] if files else None
