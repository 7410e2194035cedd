"""The files of a DeepRacer model, as overrides (`custom_files=DIR`) and as option files of your own (`import`)."""

import contextlib
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from deepracer_exp.deepracer import hyperparameters, model_metadata
from deepracer_exp.deepracer.hyperparameters import Hyperparameters, read_hyperparameters
from deepracer_exp.deepracer.model_metadata import (
    LIDARS,
    NEURAL_NETWORKS,
    ModelMetadata,
    read_model_metadata,
)
from deepracer_exp.errors import BadInput
from deepracer_exp.files import read_bytes

from .experiment import safe_name
from .options import conf_dirs
from .overrides import override_line, parse_single

KEY = "custom_files"

PLACES = {
    "reward_function.py": ("reward_function.py",),
    "model_metadata.json": ("model_metadata.json", "model/model_metadata.json"),
    "hyperparameters.json": ("hyperparameters.json", "ip/hyperparameters.json"),
}
"""Where each file is in deepracer-for-cloud's `custom_files/`, and in the folder of a trained model."""

TAKEN = {
    "lr": "algorithm.lr",
    "batch_size": "algorithm.batch_size",
    "num_epochs": "algorithm.epochs",
    "discount_factor": "algorithm.discount",
    "beta_entropy": "algorithm.entropy_coeff",
    "loss_type": "algorithm.loss_type",
    "num_episodes_between_training": "algorithm.episodes_per_iteration",
    "term_cond_max_episodes": "budget.iterations",
}
"""Keys of hyperparameters.json and our keys for the same values."""

FRAMES = "algorithm.frames_per_iteration"
"""Our alternative length of an iteration; null where the file's number of episodes is used."""

NOT_APPLICABLE = {
    "e_greedy_value": "for e-greedy exploration; here actions are drawn from the policy",
    "epsilon_steps": "for e-greedy exploration; here actions are drawn from the policy",
    "stack_size": "the service ignores it, too",
    "term_cond_avg_score": "the service only stores it",
    "sac_alpha": "for SAC only",
    "sensor": "here observation=NAME chooses what the policy sees; the same sensors:",
    "neural_network": "for camera images; here use network=NAME",
    "version": "the service's physics; here use car=NAME",
    "lidar_config": "here values of observation.lidar",
}
"""Keys of both JSON files that have no effect here, and why."""


@dataclass(frozen=True)
class CustomFiles:
    """The DeepRacer files of a folder."""

    folder: str
    """The path as given."""
    paths: Mapping[str, str]
    """Paths of the files found, by their names in PLACES."""
    metadata: ModelMetadata | None
    hyperparameters: Hyperparameters | None

    @property
    def name(self) -> str:
        """Return the folder's name for display."""
        return Path(self.folder).resolve().name or self.folder

    @property
    def action_space(self) -> dict[str, Any]:
        """Return the values of the group `action_space`; empty without a model_metadata.json."""
        if self.metadata is None:
            return {}
        low, high = self.metadata.low, self.metadata.high
        if low is None or high is None:
            listed = self.metadata.actions
            actions = [{"steering_angle": one.steering_deg, "speed": one.speed_mps} for one in listed]
            return {"kind": "discrete", "actions": actions}
        return {
            "kind": "continuous",
            "steering_angle": {"low": low.steering_deg, "high": high.steering_deg},
            "speed": {"low": low.speed_mps, "high": high.speed_mps},
        }

    @property
    def learning(self) -> dict[str, Any]:
        """Return the values that are used, by key of hyperparameters.json; empty without the file."""
        given = self.hyperparameters
        if given is None:
            return {}
        # The service's default is no limit in practice, so that ours is kept.
        return {
            key: getattr(given, key) for key in TAKEN if key != "term_cond_max_episodes" or key in given.given
        }

    def remarks(self) -> list[str]:
        """Return a line for each key that is not used or that needs an explanation."""
        metadata = self._metadata_remarks(self.metadata) if self.metadata else ()
        learning = self._learning_remarks(self.hyperparameters) if self.hyperparameters else ()
        return [
            *(f"model_metadata.json: {what}: {why}" for what, why in metadata),
            *(f"hyperparameters.json: {what}: {why}" for what, why in learning),
        ]

    def _metadata_remarks(self, metadata: ModelMetadata) -> Iterable[tuple[str, str]]:
        values = {
            "sensor": ", ".join(metadata.sensor),
            "neural_network": metadata.neural_network,
            "version": metadata.version,
        }
        for key in metadata.given:
            if key in NOT_APPLICABLE:
                shown = f"{key}={values[key]}" if key in values else key
                same = [" ".join(sensor_overrides(metadata))] if key == "sensor" else []
                yield shown, " ".join([f"not applicable: {NOT_APPLICABLE[key]}", *same])
        if metadata.renumbered:
            yield "action_space: index", "ignored: an action's number is its position, as in the service"
        yield from _unknown(metadata.given, model_metadata.KEYS)

    def _learning_remarks(self, given: Hyperparameters) -> Iterable[tuple[str, str]]:
        missing = [f"{key}={value}" for key, value in self.learning.items() if key not in given.given]
        if missing:
            yield ", ".join(missing), "missing in the file; the service's default is used"
        for key in given.beyond_console():
            yield f"{key}={getattr(given, key)}", "used, although the AWS console would not accept it"
        if given.exploration_type != "categorical":
            yield (
                f"exploration_type={given.exploration_type}",
                "not applicable: here actions are drawn from the policy (categorical)",
            )
        for key in given.given:
            if key in NOT_APPLICABLE:
                yield f"{key}={getattr(given, key)}", f"not applicable: {NOT_APPLICABLE[key]}"
        yield from _unknown(given.given, hyperparameters.KEYS)


def sensor_overrides(metadata: ModelMetadata) -> list[str]:
    """Return the overrides with which a policy sees what the sensors of a model do."""
    stereo = "STEREO_CAMERAS" in metadata.sensor
    lidar = next((name for name in metadata.sensor if name in LIDARS), None)
    if lidar is None:
        return ["observation=stereo" if stereo else "observation=camera"]
    lines = ["observation=camera_lidar"] + ["observation.camera.stereo_m=0.06"] * stereo
    if lidar == "SECTOR_LIDAR":
        lines.append("observation.lidar.kind=sectors")
    elif lidar == "DISCRETIZED_SECTOR_LIDAR":
        sectors, values, clip_m = metadata.lidar_config
        lines += [
            "observation.lidar.kind=discretized",
            f"observation.lidar.sectors={sectors}",
            f"observation.lidar.values_per_sector={values}",
            f"observation.lidar.reach_m={clip_m:g}",
        ]
    return lines


_NETWORKS = dict(zip(NEURAL_NETWORKS, ("shallow", "medium", "deep"), strict=True))
_STEREO: Mapping[str, Any] = {
    "filters": [32, 64, 64, 128, 128],
    "kernels": [3, 3, 3, 3, 3],
    "strides": [1, 2, 1, 2, 1],
}
"""Layers of the service's two deeper networks for two cameras (deepracer-simapp, `sensors/utils.py`)."""


def services_network(metadata: ModelMetadata) -> tuple[str, dict[str, Any]]:
    """Return the option of the network that the service builds for a model, and what it has instead of its values."""
    name = _NETWORKS[metadata.neural_network]
    return name, dict(_STEREO) if "STEREO_CAMERAS" in metadata.sensor and name != "shallow" else {}


def network_overrides(metadata: ModelMetadata) -> list[str]:
    """Return the overrides for the network that the service builds for a model."""
    name, values = services_network(metadata)
    return [f"network={name}", *(override_line(f"network.{key}", value) for key, value in values.items())]


def read_custom_files(folder: str) -> CustomFiles:
    """Read the JSON files of a folder and find its reward function.

    Raises:
        BadInput: there is no such folder, it has none of the files, or one of them cannot be used.
    """
    accepted = "a folder with reward_function.py, model_metadata.json or hyperparameters.json"
    if not folder:
        raise BadInput(f"{KEY}='': no folder; accepted: {accepted}")
    try:
        names = [path.name for path in Path(folder).iterdir()]
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise BadInput(f"{KEY} {folder}: cannot be read ({reason}); accepted: {accepted}") from error
    paths = {}
    for name, places in PLACES.items():
        # Any kind of file of that name is used: its reader reports what is wrong with it.
        there = [Path(folder, place) for place in places if os.path.lexists(Path(folder, place))]
        if there:
            paths[name] = str(there[0])
    if not paths:
        # A file's name may contain line breaks.
        held = [" ".join(name.split()) for name in sorted(names)[:5]] + ["..."] * (len(names) > 5)
        raise BadInput(f"{KEY} {folder}: holds {', '.join(held) or 'nothing'}; accepted: {accepted}")
    metadata = paths.get("model_metadata.json")
    learning = paths.get("hyperparameters.json")
    files = CustomFiles(
        folder,
        paths,
        read_model_metadata(metadata) if metadata else None,
        read_hyperparameters(learning) if learning else None,
    )
    if files.metadata is not None and files.metadata.training_algorithm != "clipped_ppo":
        raise BadInput(
            f"{metadata}: training_algorithm: {files.metadata.training_algorithm}; accepted: clipped_ppo, the only "
            "algorithm so far"
        )
    return files


@dataclass(frozen=True)
class FileOverrides:
    """The overrides that a folder of files stands for; the user's own have priority over them."""

    lines: tuple[str, ...]
    names: Mapping[str, str]
    """Display names of the reward and the action space that come from the folder."""
    notes: tuple[str, ...]
    """What was used, and what was not and why, a line each."""


def file_overrides(files: CustomFiles, own: Mapping[str, str]) -> FileOverrides:
    """Turn files into overrides.

    Args:
        files: the files found.
        own: the user's own overrides by key or group; they have priority.
    """
    lines: list[str] = []
    names: dict[str, str] = {}
    notes = [
        f"{KEY}={files.folder}: {', '.join(os.path.relpath(p, files.folder) for p in files.paths.values())}"
    ]

    reward = files.paths.get("reward_function.py")
    if reward is not None:
        winner = _first(own, "reward", "reward.name", "reward.file")
        if winner is None:
            names["reward"] = files.name
            lines += [override_line("reward.file", reward), override_line("reward.name", files.name)]
            notes.append("reward_function.py: used as reward.file")
        else:
            notes.append(f"reward_function.py: not used, because of {winner}")

    if files.action_space:
        winner = _first(own, "action_space", "action_space.kind", "action_space.file")
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

    taken = []
    for key, value in files.learning.items():
        target = TAKEN[key]
        group = target.partition(".")[0]
        winner = _first(own, group, target)
        if key == "num_episodes_between_training":
            frames = own.get(FRAMES)
            if frames is not None and frames != f"{FRAMES}=null":
                winner = winner or frames
            elif group not in own:
                lines.append(override_line(FRAMES, None))
        if winner is None:
            taken.append(f"{target}={value}")
            lines.append(override_line(target, value))
        else:
            notes.append(f"hyperparameters.json: {key}={value}: not used, because of {winner}")
    if taken:
        notes.append(f"hyperparameters.json: used as {', '.join(taken)}")
    return FileOverrides(tuple(lines), names, (*notes, *files.remarks()))


def _first(own: Mapping[str, str], *keys: str) -> str | None:
    """Return the first of these overrides that the user gave."""
    return next((own[key] for key in keys if key in own), None)


def _unknown(given: Iterable[str], known: Iterable[str]) -> Iterable[tuple[str, str]]:
    unknown = [key for key in given if key not in known]
    if unknown:
        yield ", ".join(unknown), "ignored, as by the service"


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
    """Write `./conf/GROUP/NAME.yaml` for each file and `./conf/experiment/NAME.yaml` for all of them.

    Args:
        files: the files of a folder.
        name: name of the new options.
        mapping: the experiment that the files describe, validated.
        more: overrides that belong to the experiment, too.
        source: where the files come from, if their folder is a temporary one.

    Returns:
        The files written, the experiment's last.

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
            keys = [target.removeprefix("algorithm.") for target in (*TAKEN.values(), FRAMES)]
            values = {"defaults": ["ppo"]} | {key: values[key] for key in keys if key in values}
        texts[Path("conf", group, f"{name}.yaml")] = _option(source or files.paths[file], values)
    experiment: dict[str, Any] = {
        "defaults": [{f"override /{group}": name} for group in imported.values()],
        "name": name,
    }
    for override in map(parse_single, more):
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


def _option(source: str, values: Mapping[str, Any]) -> bytes:
    """Return the text of an option file that says where its values come from."""
    # On one line even if the path has line breaks.
    comment = f"# Imported from {re.sub(r'[^ -~]+', ' ', str(Path(source).resolve()))}.\n"
    return (comment + yaml.safe_dump(values, sort_keys=False, allow_unicode=True)).encode()


def _write_all(texts: Mapping[Path, bytes]) -> None:
    """Write all files or none."""
    try:
        for path, text in texts.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(text)
    except OSError as error:
        remove_options(texts)
        raise BadInput(
            f"{error.filename}: cannot be written ({error.strerror}); your own options are written to ./conf"
        ) from error


def remove_options(paths: Iterable[Path]) -> None:
    """Remove option files, and the folders that are empty then."""
    for path in paths:
        for remove in (path.unlink, path.parent.rmdir, path.parent.parent.rmdir):
            with contextlib.suppress(OSError):  # not there, or a folder with other files
                remove()
