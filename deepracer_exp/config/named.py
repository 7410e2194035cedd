"""Options that a protocol, a recording or a model of the service refers to by name."""

from collections.abc import Mapping
from typing import Any

from deepracer_exp.aws.models.model_metadata import NEURAL_NETWORKS, ModelMetadata
from deepracer_exp.errors import naming

from .car import CarConfig
from .compose import compose_experiment, compose_option
from .driving import RandomizationConfig, TrackConfig
from .evaluation import EvaluationConfig
from .experiment import Experiment
from .learning import CNNConfig
from .overrides import override_line
from .racing import RaceConfig


def tracks_of(experiment: Experiment, config: EvaluationConfig) -> dict[str, TrackConfig]:
    """Return the tracks of a protocol, or those of the experiment, by name.

    Raises:
        BadInput: a track is unknown.
    """
    if config.tracks is None:
        return experiment.tracks
    names = config.tracks if isinstance(config.tracks, str) else list(config.tracks)
    with naming("evaluation.tracks"):
        return compose_experiment([override_line("track", names)])[0].tracks


def conditions_of(experiment: Experiment, config: EvaluationConfig, key: str) -> RandomizationConfig:
    """Return the conditions of a protocol at one of its keys, `usual` or `held_out`, or those of the experiment.

    Raises:
        BadInput: there are no such conditions.
    """
    if (option := getattr(config, key)) is None:
        return experiment.randomization
    with naming(f"evaluation.{key}"):
        return compose_option("randomization", option, RandomizationConfig)


def race_of(experiment: Experiment, config: EvaluationConfig) -> RaceConfig:
    """Return the race of a protocol, or that of the experiment.

    Raises:
        BadInput: there is no such race.
    """
    if config.race is None:
        return experiment.race
    with naming("evaluation.race"):
        return compose_option("race", config.race, RaceConfig)


def no_randomization() -> RandomizationConfig:
    """Return the conditions in which every episode has the same car: `randomization=none`."""
    return compose_option("randomization", "none", RandomizationConfig)


def service_car() -> CarConfig:
    """Return the car of the service's simulation: `car=deepracer`."""
    return compose_option("car", "deepracer", CarConfig)


_NETWORKS = dict(zip(NEURAL_NETWORKS, ("shallow", "medium", "deep"), strict=True))
_STEREO: Mapping[str, Any] = {
    "filters": [32, 64, 64, 128, 128],
    "kernels": [3, 3, 3, 3, 3],
    "strides": [1, 2, 1, 2, 1],
}
"""Layers of the service's two deeper networks for two cameras (deepracer-simapp, `sensors/utils.py`)."""


def services_layers(metadata: ModelMetadata) -> dict[str, Any]:
    """Return all values of the network that the service builds for a model, by key of `CNNConfig`."""
    name = _NETWORKS[metadata.neural_network]
    return vars(compose_option("network", name, CNNConfig)) | _differing(metadata)


def network_overrides(metadata: ModelMetadata) -> list[str]:
    """Return the overrides for the network that the service builds for a model."""
    values = _differing(metadata).items()
    return [
        f"network={_NETWORKS[metadata.neural_network]}",
        *(override_line(f"network.{key}", value) for key, value in values),
    ]


def _differing(metadata: ModelMetadata) -> dict[str, Any]:
    """Return the values in which a network differs from its option."""
    is_shallow = metadata.neural_network == NEURAL_NETWORKS[0]
    return dict(_STEREO) if "STEREO_CAMERAS" in metadata.sensor and not is_shallow else {}
