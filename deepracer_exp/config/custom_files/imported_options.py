"""The files of a DeepRacer model as option files of your own (`deepracer-exp import`)."""

import contextlib
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from deepracer_exp.aws.models.model_metadata import Action
from deepracer_exp.config.experiment import safe_name
from deepracer_exp.config.options import conf_dirs
from deepracer_exp.config.overrides import parse_single
from deepracer_exp.errors import BadInput
from deepracer_exp.files import read_bytes

from .file_overrides import car_override
from .job_overrides import job_overrides
from .model_files import FRAMES, CustomFiles

_GROUPS = {
    "reward_function.py": "reward",
    "model_metadata.json": "action_space",
    "hyperparameters.json": "algorithm",
}


def import_files(
    files: CustomFiles,
    name: str,
    mapping: Mapping[str, Any],
    more: Sequence[str] = (),
    source: str | None = None,
) -> list[Path]:
    """Write and return `./conf/GROUP/NAME.yaml` for each file and, last, `./conf/experiment/NAME.yaml` for all of them.

    Args:
        files: the files of a folder.
        name: name of the new options.
        mapping: the experiment that the files describe, validated.
        more: overrides that belong to the experiment, too.
        source: where the files come from, if their folder is a temporary one.

    Raises:
        BadInput: the name cannot be used or is taken, or a file cannot be written; then none is.
    """
    _check_name(name)
    texts: dict[Path, bytes] = {}
    imported = {file: group for file, group in _GROUPS.items() if file in files.paths}
    for file, group in imported.items():
        values = dict(mapping[group])
        if group == "reward":
            texts[Path("conf/reward", f"{name}.py")] = read_bytes(files.paths[file], "a Python file")
            values |= {"name": name, "file": f"${{conf:'reward/{name}.py'}}"}
        elif group == "algorithm":
            keys = [target.removeprefix("algorithm.") for target in (*files.taken.values(), FRAMES)]
            base = "sac" if files.is_sac else "ppo"
            values = {"defaults": [base]} | {key: values[key] for key in keys if key in values}
        texts[Path("conf", group, f"{name}.yaml")] = _option(source or files.paths[file], values)
    experiment: dict[str, Any] = {
        "defaults": [{f"override /{group}": name} for group in imported.values()],
        "name": name,
    }
    if files.is_sac and "algorithm" not in imported.values():
        experiment["defaults"].append({"override /algorithm": "sac"})
    job = job_overrides(files.job, {})[0] if files.job else ()
    for override in map(parse_single, (*car_override(files, {})[0], *job, *more)):
        group, _, key = override.key_or_group.partition(".")
        if key:
            *above, leaf = group, *key.split(".")
            node = experiment
            for part in above:
                node = node.setdefault(part, {})
            node[leaf] = override.value()
        else:
            experiment["defaults"].append({f"override /{group}": override.value()})
    if (iterations := files.learning.get("term_cond_max_episodes")) is not None:
        experiment.setdefault("budget", {})["iterations"] = iterations
    texts[Path("conf/experiment", f"{name}.yaml")] = b"# @package _global_\n" + _option(
        source or files.folder, experiment
    )
    _check_free(texts, name)
    _write_all(texts)
    return list(texts)


def check_action_space_name(name: str) -> None:
    """Check the name of a new option of the group `action_space`.

    Raises:
        BadInput: it cannot be used or is taken.
    """
    _check_name(name)
    _check_free([_action_space_file(name)], name)


def write_action_space(name: str, actions: Iterable[Action], comment: str) -> Path:
    """Write a list of actions as `./conf/action_space/NAME.yaml`.

    `comment` is a line that says where they come from.

    Raises:
        BadInput: as for `check_action_space_name`, or the file cannot be written.
    """
    check_action_space_name(name)
    path = _action_space_file(name)
    lines = [
        f"  - {{steering_angle: {action.steering_deg}, speed: {action.speed_mps}}}\n" for action in actions
    ]
    text = f"{_comment(comment)}kind: discrete\nactions:\n{''.join(lines)}file: null\n"
    _write_all({path: text.encode()})
    return path


def _action_space_file(name: str) -> Path:
    return Path("conf", "action_space", f"{name}.yaml")


def _check_free(paths: Iterable[Path], name: str) -> None:
    searched = conf_dirs()
    for path in paths:
        for folder in (Path("conf"), *searched):
            taken = folder / path.relative_to("conf")
            if os.path.lexists(taken):
                raise BadInput(f"--name {name}", f"{taken} exists already", "a new name")


def _check_name(name: str) -> None:
    try:
        safe_name(name)
        plain = parse_single(f"experiment={name}").value() == name == yaml.safe_load(name)
    except ValueError as error:
        raise BadInput(f"--name {name!r}", error) from error
    if not plain or name.endswith(".yaml"):
        raise BadInput(f"--name {name}", "would not be read as a name", "a name that begins with a letter")


def _option(source: str, values: Mapping[str, Any]) -> bytes:
    """Return the text of an option file that says where its values come from."""
    comment = _comment(f"Imported from {Path(source).resolve()}.")
    return (comment + yaml.safe_dump(values, sort_keys=False, allow_unicode=True)).encode()


def _comment(text: str) -> str:
    """Return a comment on one line even if the text has line breaks."""
    return f"# {re.sub(r'[^ -~]+', ' ', text)}\n"


def _write_all(texts: Mapping[Path, bytes]) -> None:
    """Write all files or none."""
    try:
        for path, text in texts.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(text)
    except OSError as error:
        remove_options(texts)
        raise BadInput(
            error.filename, f"cannot be written ({error.strerror}); your own options are written to ./conf"
        ) from error


def remove_options(paths: Iterable[Path]) -> None:
    """Remove option files, and the folders that are empty then."""
    for path in paths:
        for remove in (path.unlink, path.parent.rmdir, path.parent.parent.rmdir):
            with contextlib.suppress(OSError):  # not there, or a folder with other files
                remove()
