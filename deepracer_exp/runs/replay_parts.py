"""`replay/` of a run folder: the steps of a replay, each written once; a resumed run learns from the same ones."""

import re
import shutil
from pathlib import Path

from tensordict import TensorDict, TensorDictBase
from torchrl.checkpoint import Checkpoint, StateDictCheckpointAdapter

from deepracer_exp.agents.replay import Replay
from deepracer_exp.errors import BadInput, RunFailed, count

from .checkpoint_files import write_hashes
from .components import State, check_folder, load_component, one_line
from .files import REPLAY

_STEPS = "steps"
_PROBLEM = "a training cannot resume from it"
_NAME = re.compile(r"(\d{12})-(\d{12})")


class ReplayParts:
    """The parts of one run's replay, one folder for each: rows FIRST to END - 1 of the run in `FIRST-END`.

    A part is written aside with the hashes of its files and moved into place before the checkpoint that needs it
    becomes `last`, and removed only after two newer ones have. So whenever the run is killed, the parts that `last`
    needs are whole, and so are those of the one before, from which a run resumes if `last` is corrupt.
    """

    def __init__(self, run_dir: Path):
        """Open the folder, if there is one, and clear away what a kill left unfinished."""
        self.folder = run_dir / REPLAY
        self._first_row_before = 0
        for path in self.folder.glob(".*"):
            shutil.rmtree(path)

    def write(self, replay: Replay) -> None:
        """Write the rows that no part has yet.

        Raises:
            RunFailed: the folder cannot be written.
        """
        stored = self._stored()
        for begin, rows in replay.parts(stored[-1][1] if stored else 0):
            name = f"{begin:012d}-{begin + len(rows):012d}"
            aside = self.folder / f".{name}"
            try:
                self.folder.mkdir(exist_ok=True)
                steps = State(dict(rows.items()))
                archive = StateDictCheckpointAdapter("archive")
                Checkpoint().register(_STEPS, steps, adapter=archive).save(aside, metadata={})
                write_hashes(aside)
                aside.rename(self.folder / name)
            except (RuntimeError, OSError) as error:  # RuntimeError: torch's, for a full disk
                shutil.rmtree(aside, ignore_errors=True)
                reason = str(error).splitlines()[0]
                raise RunFailed(f"{self.folder / name}: the replay cannot be written: {reason}") from error

    def drop(self, replay: Replay) -> None:
        """Remove the parts whose rows were not in the replay any more when this was called before."""
        for _, end, path in self._stored():
            if end <= self._first_row_before:
                shutil.rmtree(path)
        self._first_row_before = replay.first_row

    def restore(self, replay: Replay) -> None:
        """Fill a replay whose state was restored with its rows, and remove the parts that came later.

        Raises:
            BadInput: a part is missing or corrupt.
        """
        stored = self._stored()
        needed = [part for part in stored if part[1] > replay.first_row and part[0] < replay.written_rows]
        row = replay.first_row
        for begin, end, _ in needed:
            if begin > row:
                break
            row = end
        if row != replay.written_rows:
            steps = count((replay.written_rows - row) * replay.cars, "step")
            raise BadInput(
                self.folder,
                f"{steps} of the replay of the last checkpoint are missing; restore the folder, or start a new run "
                "from the checkpoint with `deepracer-exp clone`",
            )
        replay.restore([(begin, _read(path)) for begin, _, path in needed])
        for begin, _, path in stored:
            if begin >= replay.written_rows:
                shutil.rmtree(path)

    def _stored(self) -> list[tuple[int, int, Path]]:
        """Return the first row, the end and the folder of each part, the oldest first."""
        if not self.folder.is_dir():
            return []
        names = ((_NAME.fullmatch(path.name), path) for path in self.folder.iterdir())
        return sorted((int(name[1]), int(name[2]), path) for name, path in names if name is not None)


def _read(path: Path) -> TensorDictBase:
    """Return the rows of a part."""
    check_folder(path, {_STEPS}, {_STEPS})
    state = State({})
    load_component(path, _STEPS, state, _PROBLEM)
    try:
        return TensorDict(dict(state.values), state.values["reward"].shape[:2])
    except (KeyError, AttributeError, RuntimeError) as error:
        raise BadInput(path, f"{_PROBLEM}: {one_line(error)}") from error
