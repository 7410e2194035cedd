"""The files of a DeepRacer model, imported as option files of your own."""

import contextlib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from deepracer_exp.errors import BadInput
from deepracer_exp.files import read_bytes

from .compose import Composition
from .custom_files import CustomFiles
from .experiment import safe_name
from .options import conf_dirs
from .overrides import parse_single

_GROUPS = {
    "reward_function.py": "reward",
    "model_metadata.json": "action_space",
    "hyperparameters.json": "algorithm",
}

_REWARD = """\
# Imported from {source}.
# A name for display; the file below is used.
name: {name}
# The reward function beside this file.
file: {file}
# Values for the constants in capitals of the module, e.g. reward.constants.NAME=2.
constants: {constants}
# Seconds of CPU that one control step's reward calls may take, all cars together, before the run is failed.
time_limit_s: {time_limit_s}
"""

_DISCRETE = """\
# Imported from {source}.
# discrete: the policy picks one of the actions below.
kind: discrete
# One line per action: steering_angle in degrees, positive to the left; speed in m/s.
# The position in the list is the action's number.
actions:
{actions}
# A model_metadata.json that replaces everything above; null: none.
file: null
"""

_CONTINUOUS = """\
# Imported from {source}.
# continuous: the policy outputs two numbers between -1 and 1 (steering, speed).
kind: continuous
# Steering angle in degrees, positive to the left: low at -1, high at 1.
steering_angle: {steering_angle}
# Speed in m/s: low at -1, high at 1.
speed: {speed}
# A model_metadata.json that replaces everything above; null: none.
file: null
"""

_ALGORITHM = {
    "lr": "Initial learning rate; lr_schedule changes it during training.",
    "batch_size": "Steps per gradient step.",
    "epochs": "Passes over each iteration's steps (num_epochs).",
    "discount": "Discount factor per step of 1/15 s (discount_factor).",
    "entropy_coeff": "Entropy bonus (beta_entropy).",
    "loss_type": "Loss of the value network: huber or mean squared error.",
    "frames_per_iteration": "Control steps between two updates; null: episodes_per_iteration is used.",
    "episodes_per_iteration": "Finished episodes between two updates (num_episodes_between_training).",
}


def import_files(files: CustomFiles, name: str, composition: Composition) -> list[Path]:
    """Write `./conf/GROUP/NAME.yaml` for each file and `./conf/experiment/NAME.yaml` for all of them.

    Args:
        files: the files of a folder.
        name: name of the new options.
        composition: the experiment that the files describe, validated.

    Returns:
        The files written, the experiment's last.

    Raises:
        BadInput: the name cannot be used or is taken, or a file cannot be written; then none is.
    """
    _check_name(name)
    texts = _texts(files, name, composition)
    searched = conf_dirs()
    for path in texts:
        for folder in (Path("conf"), *searched):
            taken = folder / path.relative_to("conf")
            if os.path.lexists(taken):
                raise BadInput(f"--name {name}: {taken} exists already; accepted: a new name")
    _write_all(texts)
    return list(texts)


def _check_name(name: str) -> None:
    try:
        safe_name(name)
        plain = parse_single(f"experiment={name}").value() == name == yaml.safe_load(name)
    except ValueError as error:
        raise BadInput(f"--name {name!r}: {error}") from error
    if not plain or name.endswith(".yaml"):
        raise BadInput(
            f"--name {name}: would not be read as a name; accepted: a name that begins with a letter"
        )


def _texts(files: CustomFiles, name: str, composition: Composition) -> dict[Path, str | bytes]:
    """Return the files to write, by path (`conf/...`)."""
    imported = [group for file, group in _GROUPS.items() if file in files.paths]
    texts: dict[Path, str | bytes] = {}
    for file, group in _GROUPS.items():
        if file not in files.paths:
            continue
        # On one line even if the path has line breaks: it goes into a comment.
        source = re.sub(r"\s+", " ", str(Path(files.paths[file]).resolve()))
        values = composition.mapping[group]
        if group == "reward":
            texts[Path("conf/reward", f"{name}.py")] = read_bytes(files.paths[file], "a Python file")
            text = _reward(source, name, values)
        elif group == "action_space":
            text = _action_space(source, values)
        else:
            text = _algorithm(source, values)
        texts[Path("conf", group, f"{name}.yaml")] = text
    iterations = files.learning.get("term_cond_max_episodes")
    texts[Path("conf/experiment", f"{name}.yaml")] = _experiment(files, name, imported, iterations)
    return texts


def _reward(source: str, name: str, values: Mapping[str, Any]) -> str:
    return _REWARD.format(
        source=source,
        name=_flow(name),
        file=f"\"${{conf:'reward/{name}.py'}}\"",
        constants=_flow(values["constants"]),
        time_limit_s=values["time_limit_s"],
    )


def _action_space(source: str, values: Mapping[str, Any]) -> str:
    if values["kind"] == "continuous":
        ranges = {key: _flow(values[key]) for key in ("steering_angle", "speed")}
        return _CONTINUOUS.format(source=source, **ranges)
    actions = "\n".join(f"  - {_flow(action)}" for action in values["actions"])
    return _DISCRETE.format(source=source, actions=actions)


def _algorithm(source: str, values: Mapping[str, Any]) -> str:
    lines = [f"# Imported from {source}; all other keys as in algorithm/ppo.yaml.", "defaults:", "  - ppo"]
    for key, meaning in _ALGORITHM.items():
        lines += [f"# {meaning}", f"{key}: {_flow(values[key])}"]
    return "\n".join(lines) + "\n"


def _experiment(files: CustomFiles, name: str, imported: list[str], iterations: int | None) -> str:
    source = re.sub(r"\s+", " ", str(Path(files.folder).resolve()))
    lines = [
        "# @package _global_",
        f"# Imported by `deepracer-exp import` from {source}; all else as in our defaults.",
    ]
    lines += ["defaults:", *(f"  - override /{group}: {_flow(name)}" for group in imported)]
    lines += ["# Folder under runs_dir, and experiment in MLflow.", f"name: {_flow(name)}"]
    if iterations is not None:
        lines += ["budget:", "  # Updates of the policy (term_cond_max_episodes, which counts them)."]
        lines += [f"  iterations: {iterations}"]
    return "\n".join(lines) + "\n"


def _flow(value: Any) -> str:
    """Return a value as YAML on one line."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=float("inf"))
    return text.removesuffix("...\n").strip()


def _write_all(texts: Mapping[Path, str | bytes]) -> None:
    """Write all files or none: they are written under temporary names first, where most failures occur."""
    made: list[Path] = []
    folders: list[Path] = []
    try:
        for path, text in texts.items():
            for folder in (path.parent.parent, path.parent):
                if not folder.is_dir():
                    folder.mkdir()
                    folders.append(folder)
            aside = path.with_name(f".{path.name}.tmp")
            made.append(aside)
            aside.write_bytes(text if isinstance(text, bytes) else text.encode())
        for path in texts:
            path.with_name(f".{path.name}.tmp").replace(path)
            made.append(path)
    except BaseException as error:
        for path in made:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
        for folder in reversed(folders):
            with contextlib.suppress(OSError):
                folder.rmdir()
        if not isinstance(error, OSError):
            raise
        raise BadInput(
            f"{error.filename}: cannot be written ({error.strerror}); your own options are written to ./conf"
        ) from error
