"""Folders of option files: `conf/` and `sweeps/` of the project, `./conf` and `./sweeps` of the working directory."""

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import yaml

from deepracer_exp.aws.worlds.catalogue import worlds
from deepracer_exp.errors import BadInput, nearest
from deepracer_exp.files import read_bytes, read_text

SWEEP = "sweep"
"""The group whose options are the ready-made studies."""
MOST_LISTED = 24
"""Most options that a message lists."""
DEEPEST = 3
"""Most parts of an option's path below `conf/`, as in `sweep/executor/local.yaml`."""
FileState = tuple[str, int, int, int]
"""Path of a file, times of its last changes (contents; contents or attributes) in nanoseconds, and size."""


def project_dir(name: str) -> Path:
    """Return a folder of the repository (`conf`, `reward_zoo`, `sweeps`); an installed wheel has a copy in `data/`."""
    packed = Path(__file__).parents[1] / "data" / name
    return packed if packed.is_dir() else Path(__file__).parents[2] / name


def conf_dir() -> Path:
    """Return the project's folder of options."""
    return project_dir("conf")


def conf_dirs() -> list[Path]:
    """Return the absolute folders that are searched: the project's, then `./conf` if it is another one.

    Raises:
        BadInput: both have an option of the same name with different contents.
    """
    project, user = conf_dir().resolve(), Path("conf")
    try:
        if not user.is_dir() or user.samefile(project):
            return [project]
        for group in sorted(str(path.relative_to(project)) for path in project.rglob("*/") if path.is_dir()):
            for path in sorted((user / group).glob("*.yaml")):
                namesake = project / group / path.name
                another = namesake.is_file() and namesake.read_bytes() != read_bytes(path, "an option")
                if another or (group == "track" and path.stem in worlds() and not namesake.is_file()):
                    raise BadInput(path, f"the project has another {group} of that name; rename the file")
        return [project, user.resolve()]
    except OSError as error:
        raise BadInput(
            error.filename, f"cannot be read ({error.strerror}); ./conf is for options of your own"
        ) from error


def sweep_files() -> dict[str, Path]:
    """Return the options of the group `sweep` by name: the studies in `sweeps/` and `./sweeps`, and those in `conf/`.

    Raises:
        BadInput: two of them have the same name and different contents.
    """
    files: dict[str, Path] = {}
    for folder in (project_dir("sweeps"), conf_dir() / SWEEP, Path("sweeps"), Path("conf", SWEEP)):
        for path in sorted(folder.glob("*.yaml")):
            namesake = files.setdefault(path.stem, path)
            if namesake != path and read_bytes(path, "an option") != read_bytes(namesake, "an option"):
                raise BadInput(path, f"{namesake} has the same name; rename the file")
    return files


def option_files() -> tuple[FileState, ...]:
    """Return all option and study files, with stamps that change with them.

    Raises:
        BadInput: as `conf_dirs`.
    """
    folders = [*conf_dirs(), project_dir("sweeps"), Path("sweeps").absolute()]
    # A link to a folder is followed by `*`, which `**` would not do.
    patterns = [f"{'*/' * depth}*.yaml" for depth in range(DEEPEST)]
    files = {path for folder in folders for pattern in patterns for path in folder.glob(pattern)}
    return tuple(_state(path) for path in sorted(files))


def _state(path: Path) -> FileState:
    try:
        state = path.stat()
    except OSError:  # a broken link; refused when it is read
        return str(path), 0, 0, 0
    return str(path), state.st_mtime_ns, state.st_ctime_ns, state.st_size


def find(name: str) -> str:
    """Return the path of a file among the options, e.g. ``reward/mine.py``, in the first folder that has it."""
    paths = [folder / name for folder in conf_dirs()]
    return str(next((path for path in paths if path.is_file()), paths[-1]))


@cache
def groups(entry: str = "train") -> list[str]:
    """Return the sorted names of the groups that an entry point (`conf/<entry>.yaml`) composes."""
    defaults = yaml.safe_load((conf_dir() / f"{entry}.yaml").read_text(encoding="utf-8"))["defaults"]
    return sorted(group for item in defaults if isinstance(item, dict) for group in item)


def options(group: str) -> list[str]:
    """Return the sorted names of a group's options; the service's worlds have no file."""
    files = {path.stem for folder in conf_dirs() for path in (folder / group).glob("*.yaml")}
    if group == SWEEP:
        files |= sweep_files().keys()
    return sorted(files | (set(worlds()) if group == "track" else set()))


def listed(group: str, names: Sequence[str]) -> str:
    """Return a group's options for a message, or the command that lists them if there are many."""
    if len(names) <= MOST_LISTED:
        return ", ".join(names)
    return f"{len(names)}, `deepracer-exp train --options {group}` lists them"


def options_of(group: str) -> dict[str, str]:
    """Return a one-sentence description of each option of a group, by its name, sorted.

    Raises:
        BadInput: there is no such group.
    """
    if group not in groups():
        raise BadInput(group, f"no such group{nearest(group, groups())}; groups: {', '.join(groups())}")
    return {name: _first_sentence(Path(find(f"{group}/{name}.yaml"))) for name in options(group)}


def _first_sentence(file: Path) -> str:
    """Return the first sentence of the comment at the top of an option file, or an empty string."""
    if not file.is_file():
        return ""
    words: list[str] = []
    for line in read_text(file, "an option").splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @"):  # Hydra's
            words += line.lstrip("# ").split()
    return re.split(r"(?<=[.:]) ", " ".join(words), maxsplit=1)[0].rstrip(".:")
