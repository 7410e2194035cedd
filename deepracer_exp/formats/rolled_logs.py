"""Logs that were written in pieces: robomaker.log.2, robomaker.log.1, robomaker.log."""

from collections.abc import Sequence

from .log_folder import LogFile
from .step_tables import StepTables
from .training_log import TrainingLog


def piece_of(name: str) -> tuple[str, int]:
    """Return the name of the whole log and the age of the piece; pieces are sorted by it from the oldest on.

    The highest number is the oldest piece; that without one is being written.
    """
    stem, _, number = name.rpartition(".")
    return (stem, -int(number)) if number.isdigit() else (name, 1)


def join_rolled(logs: Sequence[tuple[LogFile, TrainingLog]]) -> list[tuple[list[LogFile], TrainingLog]]:
    """Put the pieces of rolled logs together, the earliest first: by their episodes, or else by their numbers."""
    groups: dict[tuple[str | int, ...], list[tuple[LogFile, TrainingLog]]] = {}
    of_file: dict[LogFile, int] = {}
    for file, log in logs:
        name, _ = piece_of(file.name)
        # One text may hold the logs of several workers.
        of_file[file] = of_file.get(file, -1) + 1
        groups.setdefault((*file.parts[:-1], name, of_file[file]), []).append((file, log))
    joined = []
    for pieces in groups.values():
        pieces.sort(key=_time_of_piece)
        whole = TrainingLog(
            steps=StepTables.joined([log.steps for _, log in pieces]),
            updates=[update for _, log in pieces for update in log.updates],
            evaluated_after=[count for _, log in pieces for count in log.evaluated_after],
            iteration_of={key: value for _, log in pieces for key, value in log.iteration_of.items()},
            hyperparameters=next((log.hyperparameters for _, log in pieces if log.hyperparameters), None),
            world=next((log.world for _, log in pieces if log.world), None),
            worker=next((log.worker for _, log in pieces if log.worker is not None), None),
            job=next((log.job for _, log in pieces if log.job), None),
            checkpoints=[one for _, log in pieces for one in log.checkpoints],
            saved=[name for _, log in pieces for name in log.saved],
        )
        joined.append(([file for file, _ in pieces], whole))
    return joined


def _time_of_piece(piece: tuple[LogFile, TrainingLog]) -> tuple[int, int, int]:
    file, log = piece
    _, age = piece_of(file.name)
    if log.steps.rows:
        first = log.steps.whole.slice(0, 1)
        return first["episode"][0].as_py(), first["steps"][0].as_py(), age
    return (next(iter(log.iteration_of), -1), 0, age)
