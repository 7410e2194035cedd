"""Translates the files of a DeepRacer model and of deepracer-for-cloud into overrides (`custom_files=DIR`)."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from deepracer_exp.config.overrides import first_given, key_of, override_line, parse_single
from deepracer_exp.errors import BadInput

from .job_overrides import job_overrides
from .model_files import FRAMES, KEY, SAC_DIFFERS, CustomFiles, read_custom_files


@dataclass(frozen=True)
class FileOverrides:
    """The user's overrides, and those derived from a folder of files."""

    typed: tuple[str, ...]
    """The user's own, with `custom_files=DIR`."""
    lines: tuple[str, ...]
    """The overrides of the files, then the user's own without `custom_files=DIR`."""
    names: Mapping[str, str]
    """Display names of the reward and the action space that come from the folder."""
    notes: tuple[str, ...]
    """Each used file, and each unused one with the reason, a line each."""


def with_custom_files(overrides: Sequence[str]) -> FileOverrides:
    """Replace `custom_files=DIR` by the overrides from the files of the folder; the last of several counts.

    Every other override has priority over the files.

    Raises:
        BadInput: an override cannot be parsed, or a file cannot be used.
    """
    others = tuple(line for line in overrides if key_of(line) != KEY)
    folders = [parse_single(line).value() for line in overrides if key_of(line) == KEY]
    if not folders or folders[-1] is None:
        return FileOverrides(tuple(overrides), others, {}, ())
    typed = {parse_single(line).key_or_group: line for line in others}
    lines, names, notes = _file_overrides(read_custom_files(str(folders[-1])), typed)
    return FileOverrides(tuple(overrides), (*lines, *others), names, tuple(notes))


def _file_overrides(
    files: CustomFiles, typed: Mapping[str, str]
) -> tuple[list[str], dict[str, str], list[str]]:
    """Turn files into overrides; returns the overrides, the names and the notes of `FileOverrides`.

    `typed` has the user's own overrides by key or group; they have priority.
    """
    lines: list[str] = []
    names: dict[str, str] = {}
    notes = [
        f"{KEY}={files.folder}: {', '.join(os.path.relpath(p, files.folder) for p in files.paths.values())}"
    ]

    reward = files.paths.get("reward_function.py")
    if reward is not None:
        winner = first_given(typed, "reward", "reward.name", "reward.file")
        if winner is None:
            names["reward"] = files.name
            lines += [override_line("reward.file", reward), override_line("reward.name", files.name)]
            notes.append(f"{Path(reward).name}: used as reward.file")
        else:
            notes.append(f"{Path(reward).name}: not used, because of {winner}")

    if files.action_space:
        winner = first_given(typed, "action_space", "action_space.kind", "action_space.file")
        if winner is None:
            # Values instead of the file's path, so that config.yaml lists the actions without the file.
            values = dict(files.action_space)
            lines.append(f"action_space={values.pop('kind')}")
            lines += [override_line(f"action_space.{key}", value) for key, value in values.items()]
            names["action_space"] = files.name
            many = f"{len(values['actions'])} actions" if "actions" in values else "continuous"
            notes.append(f"model_metadata.json: used as action_space: {many}")
        else:
            notes.append(f"model_metadata.json: action_space: not used, because of {winner}")

    car, applied = car_override(files, typed)
    lines += car
    notes += applied

    taken = []
    if files.is_sac:
        winner = first_given(typed, "algorithm")
        if winner is None:
            lines.append("algorithm=sac")
            taken.append("algorithm=sac")
            notes.append(SAC_DIFFERS)
        else:
            notes.append(f"training_algorithm=sac: not used, because of {winner}")
    for key, value in files.learning.items():
        target = files.taken[key]
        group = target.partition(".")[0]
        winner = first_given(typed, group, target)
        if key == "num_episodes_between_training":
            frames = typed.get(FRAMES)
            if frames is not None and frames != f"{FRAMES}=null":
                winner = winner or frames
            elif group not in typed:
                lines.append(override_line(FRAMES, None))
        if winner is None:
            taken.append(f"{target}={value}")
            lines.append(override_line(target, value))
        else:
            notes.append(f"hyperparameters.json: {key}={value}: not used, because of {winner}")
    if taken:
        source = (
            "hyperparameters.json" if files.hyperparameters else "model_metadata.json: training_algorithm=sac"
        )
        notes.append(f"{source}: used as {', '.join(taken)}")
    job, applied = job_overrides(files.job, typed) if files.job else ([], [])
    notes += [*applied, *_unused_files(files, typed)]
    return [*lines, *job], names, [*notes, *files.remarks()]


def car_override(files: CustomFiles, typed: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """Return the override for the car of a model, unless the user chose another, and a note; none without a version."""
    if files.car is None or files.metadata is None:
        return [], []
    winner = first_given(typed, "car", "car.name")
    used = f"used as car={files.car}" if winner is None else f"not used, because of {winner}"
    lines = [override_line("car", files.car)] if winner is None else []
    return lines, [f"model_metadata.json: version={files.metadata.version}: {used}"]


def _unused_files(files: CustomFiles, typed: Mapping[str, str]) -> list[str]:
    """Return a line for each file that is not used."""
    notes = list(files.unused)
    for name, (wanted, others) in files.left.items():
        group, key = _CHOSEN_BY[name]
        winner = wanted if name in files.paths else first_given(typed, group, key)
        # A file's name may contain line breaks.
        shown = ", ".join(" ".join(os.path.relpath(path, files.folder).split()) for path in others)
        if winner is None:
            raise BadInput(
                f"{KEY} {files.folder}: holds {shown or 'none'} but no {wanted}; accepted: one file of that name, or "
                f"{key}=... beside it"
            )
        if shown:
            notes.append(f"{shown}: not used, because of {winner}")
    return notes


_CHOSEN_BY = {
    "reward_function.py": ("reward", "reward.file"),
    "model_metadata.json": ("action_space", "action_space.file"),
    "hyperparameters.json": ("algorithm", "algorithm"),
}
"""Overrides of the user that take precedence over a file."""
