"""The files of a DeepRacer model and of deepracer-for-cloud, read from a folder (`custom_files=DIR`)."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from deepracer_exp.aws.models import hyperparameters, model_metadata
from deepracer_exp.aws.models.hyperparameters import Hyperparameters, read_hyperparameters
from deepracer_exp.aws.models.job_settings import JobSettings, read_run_env
from deepracer_exp.aws.models.model_metadata import (
    LIDARS,
    ModelMetadata,
    read_model_metadata,
)
from deepracer_exp.config.parse import action_space_values
from deepracer_exp.errors import BadInput

KEY = "custom_files"

PLACES = {
    "reward_function.py": ("", "custom_files/"),
    "model_metadata.json": ("", "custom_files/", "model/"),
    "hyperparameters.json": ("", "custom_files/", "ip/"),
    "run.env": ("",),
}
"""Folders in which each file is: of deepracer-for-cloud, of one of its `experiments/`, or of a trained model."""

SIMILAR = {
    "reward_function.py": "*reward*.py",
    "model_metadata.json": "*metadata*.json",
    "hyperparameters.json": "*hyper*param*.json",
}
"""Other names under which racers keep these files: a single match is used, several are listed in a message."""

CARS = {4: "deepracer_v4", 5: "deepracer_v5", 6: "deepracer_v6"}
"""Our cars by simulation version."""

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
"""Keys of hyperparameters.json and our keys for the same values, of PPO."""

SAC_TAKEN = {
    "lr": "algorithm.lr",
    "batch_size": "algorithm.batch_size",
    "discount_factor": "algorithm.discount",
    "loss_type": "algorithm.loss_type",
    "sac_alpha": "algorithm.alpha",
}
"""Keys of a hyperparameters.json of SAC, and our keys for the same values."""

SAC_DIFFERS = (
    "SAC: sac_alpha is where the temperature begins (the service keeps it: algorithm.learn_alpha=false); iterations, "
    "replay and gradient steps are those of algorithm=sac"
)
"""Differences between a training with the service's SAC files here and on the service."""

FRAMES = "algorithm.frames_per_iteration"
"""Our alternative length of an iteration; null where the file's number of episodes is used."""

NOT_APPLICABLE = {
    "e_greedy_value": "for e-greedy exploration; here actions are drawn from the policy",
    "epsilon_steps": "for e-greedy exploration; here actions are drawn from the policy",
    "stack_size": "the service ignores it, too",
    "term_cond_avg_score": "the service only stores it",
    "sac_alpha": "for SAC only",
    "num_epochs": "for PPO only",
    "beta_entropy": "for PPO only; SAC's is sac_alpha",
    "num_episodes_between_training": "for PPO only; the service's SAC learns after every episode",
    "term_cond_max_episodes": "for PPO only: an iteration of the service's SAC is an episode, ours are longer",
    "sensor": "here observation=NAME chooses what the policy sees; the same sensors:",
    "neural_network": "for camera images; here use network=NAME",
    "version": f"no car of that simulation version; the oldest is car={CARS[4]}",
    "lidar_config": "here values of observation.lidar",
}
"""Keys of both JSON files that have no effect here, at least with one of the algorithms, and why."""


class Left(NamedTuple):
    """Files that could be one of a model's, and are not used."""

    wanted: str
    """Name of the file that is looked for: the usual one, or the one that run.env chooses."""
    paths: tuple[str, ...]


@dataclass(frozen=True)
class CustomFiles:
    """The DeepRacer files of a folder."""

    folder: str
    """The path as given."""
    paths: Mapping[str, str]
    """Paths of the files found, by their names in PLACES."""
    metadata: ModelMetadata | None
    hyperparameters: Hyperparameters | None
    job: JobSettings | None = None
    """Track, starts and race of run.env; None without."""
    left: Mapping[str, "Left"] = field(default_factory=dict)
    """Unused files with similar names, by the name in PLACES."""
    unused: tuple[str, ...] = ()
    """A line for each folder `experiments/NAME` of deepracer-for-cloud, none of which is used."""

    @property
    def name(self) -> str:
        """Return the folder's name for display."""
        return Path(self.folder).resolve().name or self.folder

    @property
    def action_space(self) -> dict[str, Any]:
        """Return the values of the group `action_space`; empty without a model_metadata.json."""
        return {} if self.metadata is None else action_space_values(self.metadata)

    @property
    def car(self) -> str | None:
        """Return the option of the car of the model's simulation version; None if the version is not given."""
        if self.metadata is None or "version" not in self.metadata.set_keys:
            return None
        return CARS.get(self.metadata.version)

    @property
    def is_sac(self) -> bool:
        """Return whether the files belong to a training with SAC: by the metadata, or else by SAC's exploration."""
        if self.metadata is not None:
            return self.metadata.training_algorithm == "sac"
        return self.hyperparameters is not None and self.hyperparameters.exploration_type == "additive_noise"

    @property
    def taken(self) -> Mapping[str, str]:
        """Return the used keys of hyperparameters.json, with our keys for the same values."""
        return SAC_TAKEN if self.is_sac else TAKEN

    @property
    def learning(self) -> dict[str, Any]:
        """Return the used values by key of hyperparameters.json; empty without the file."""
        settings = self.hyperparameters
        if settings is None:
            return {}
        # The service's default is no limit in practice, so that ours is kept.
        return {
            key: getattr(settings, key)
            for key in self.taken
            if key != "term_cond_max_episodes" or key in settings.set_keys
        }

    def remarks(self, besides: Sequence[str] = ()) -> list[str]:
        """Return a line for each key that is not used or that needs an explanation, `besides` those of the metadata."""
        metadata = self._metadata_remarks(self.metadata, besides) if self.metadata else ()
        learning = self._learning_remarks(self.hyperparameters) if self.hyperparameters else ()
        return [
            *(f"model_metadata.json: {what}: {why}" for what, why in metadata),
            *(f"hyperparameters.json: {what}: {why}" for what, why in learning),
        ]

    def _metadata_remarks(self, metadata: ModelMetadata, besides: Sequence[str]) -> Iterable[tuple[str, str]]:
        values = {
            "sensor": ", ".join(metadata.sensor),
            "neural_network": metadata.neural_network,
            "version": metadata.version,
        }
        for key in metadata.set_keys:
            if key in NOT_APPLICABLE and key not in besides and not (key == "version" and self.car):
                shown = f"{key}={values[key]}" if key in values else key
                same = [" ".join(sensor_overrides(metadata))] if key == "sensor" else []
                yield shown, " ".join([f"not applicable: {NOT_APPLICABLE[key]}", *same])
        if metadata.renumbered:
            yield "action_space: index", "ignored: an action's number is its position, as in the service"
        yield from _unknown(metadata.set_keys, model_metadata.KEYS)

    def _learning_remarks(self, settings: Hyperparameters) -> Iterable[tuple[str, str]]:
        missing = [f"{key}={value}" for key, value in self.learning.items() if key not in settings.set_keys]
        if missing:
            yield ", ".join(missing), "missing in the file; the service's default is used"
        for key in settings.beyond_console():
            yield f"{key}={getattr(settings, key)}", "used, although the AWS console would not accept it"
        if settings.exploration_type != ("additive_noise" if self.is_sac else "categorical"):
            yield (
                f"exploration_type={settings.exploration_type}",
                "not applicable: here actions are drawn from the policy (categorical, of SAC additive_noise)",
            )
        for key in settings.set_keys:
            if key in NOT_APPLICABLE and key not in self.taken:
                yield f"{key}={getattr(settings, key)}", f"not applicable: {NOT_APPLICABLE[key]}"
        yield from _unknown(settings.set_keys, hyperparameters.KEYS)


def sensor_overrides(metadata: ModelMetadata) -> list[str]:
    """Return the overrides that give a policy a model's sensors."""
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


def read_custom_files(folder: str) -> CustomFiles:
    """Read the files of a folder and find its reward function.

    Raises:
        BadInput: there is no such folder, it has none of the files, or one of them cannot be used.
    """
    accepted = f"a folder with {', '.join(list(PLACES)[:-1])} or {list(PLACES)[-1]}"
    if not folder:
        raise BadInput(f"{KEY}=''", "no folder", accepted)
    try:
        names = sorted(path.name for path in Path(folder).iterdir())
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise BadInput(f"{KEY} {folder}", f"cannot be read ({reason})", accepted) from error
    unused = _experiments(folder)
    if "training_params.yaml" in names:
        unused.append("training_params.yaml: not used; `deepracer-exp import` reads it, or give track=NAME")
    job = read_run_env(str(Path(folder, "run.env"))) if "run.env" in names else None
    paths, left = {}, {}
    for name, places in PLACES.items():
        # run.env may choose another file by its name.
        wanted = job.files.get(name, name) if job else name
        exact = [Path(folder, place, wanted) for place in places]
        similar = [
            path for place in places for path in sorted(Path(folder, place).glob(SIMILAR.get(name, name)))
        ]
        # Any kind of file of that name is used: its reader reports what is wrong with it.
        there = [path for path in exact if os.path.lexists(path)]
        if not there and wanted == name and len(similar) == 1:
            there = similar
        if there:
            paths[name] = str(there[0])
        others = tuple(str(path) for path in similar if path not in there[:1])
        if others or (wanted != name and not there):
            left[name] = Left(wanted, others)
    if not paths and not left:
        # A file's name may contain line breaks.
        held = [" ".join(name.split()) for name in names[:5]] + ["..."] * (len(names) > 5)
        inside = f"; {unused[0]}" if unused else ""
        raise BadInput(f"{KEY} {folder}", f"holds {', '.join(held) or 'nothing'}", f"{accepted}{inside}")
    metadata = paths.get("model_metadata.json")
    learning = paths.get("hyperparameters.json")
    return CustomFiles(
        folder,
        paths,
        read_model_metadata(metadata) if metadata else None,
        read_hyperparameters(learning) if learning else None,
        job,
        left,
        tuple(unused),
    )


def _experiments(folder: str) -> list[str]:
    """Return a line for each folder `experiments/NAME`, which is trained by its own name."""
    unused = []
    for path in sorted(Path(folder).glob("experiments/*/")):
        # A folder's name may contain line breaks.
        shown = " ".join(str(path).split())
        unused.append(f"experiments/{' '.join(path.name.split())}: not used; {KEY}={shown} trains it")
    return unused


def _unknown(keys: Iterable[str], used: Iterable[str]) -> Iterable[tuple[str, str]]:
    unknown = [key for key in keys if key not in used]
    if unknown:
        yield ", ".join(unknown), "ignored, as by the service"
