"""Load the weights of a model trained with the service into our networks."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch

from deepracer_exp.agents.actor_critic import PolicyNetworks
from deepracer_exp.agents.service_weights import (
    SAC_HIDDEN,
    VALUE,
    from_service,
    match_service,
    policy_of_sac,
)
from deepracer_exp.aws.models.archive import StoredModel
from deepracer_exp.aws.models.model_metadata import NEURAL_NETWORKS
from deepracer_exp.config.custom_files.model_files import SAC_DIFFERS, CustomFiles
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import CNNConfig, SACConfig
from deepracer_exp.config.named import network_overrides, services_layers
from deepracer_exp.config.overrides import override_line
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.checkpoints import networks_of


def networks_to_try(model: StoredModel, files: CustomFiles) -> Iterator[list[str]]:
    """Yield overrides for the network that the metadata names, then for the others with the model's convolutions."""
    metadata = files.metadata
    assert metadata is not None
    tensors = policy_of_sac(model.tensors, model.source) if files.is_sac else model.tensors
    held = sorted(value.shape for name, value in tensors.items() if value.ndim == 4 and "/network_1/" in name)
    for kind in dict.fromkeys((metadata.neural_network, *NEURAL_NETWORKS)):
        described = replace(metadata, neural_network=kind)
        layers = services_layers(described)
        inputs = [2 if "STEREO_CAMERAS" in metadata.sensor else 1, *layers["filters"]]
        built = zip(layers["kernels"], layers["kernels"], inputs, layers["filters"], strict=False)
        if kind == metadata.neural_network or sorted(shape for shape in built if shape[0] > 1) == held:
            hidden = [override_line("network.hidden", [*layers["hidden"], SAC_HIDDEN])]
            yield [*network_overrides(described), *(hidden if files.is_sac else [])]


def fit_weights(
    model: StoredModel, files: CustomFiles, experiment: Experiment
) -> tuple[PolicyNetworks, list[str]]:
    """Return the networks of an experiment with the weights of a model, and the names of those that it lacks.

    Raises:
        BadInput: the weights are of other networks.
    """
    assert files.metadata is not None
    sensor = files.metadata.sensor
    if not isinstance(experiment.network, CNNConfig):
        raise BadInput("network", "the weights are of a network of the service; leave network= off")
    if isinstance(experiment.algorithm, SACConfig) != files.is_sac:
        trained = "SAC" if files.is_sac else "PPO"
        raise BadInput("algorithm", f"the weights are of {trained}; leave algorithm= off")
    tensors = policy_of_sac(model.tensors, model.source) if files.is_sac else model.tensors
    with torch.device("meta"):  # shapes only: the weights of a model may take gigabytes
        networks = networks_of(experiment, None)
    absent = match_service(tensors, networks, sensor, model.source)[1]
    if absent:
        networks = networks_of(experiment, torch.Generator().manual_seed(experiment.seed))
    else:
        networks.to_empty(device="cpu")
    from_service(tensors, networks, sensor, model.source)
    return networks, absent


def remarks_on_weights(files: CustomFiles, absent: Sequence[str]) -> list[str]:
    """Return a line on each part of the networks that starts fresh."""
    notes = []
    if files.is_sac:
        notes.append(
            "of SAC the policy is used: the service's critics see actions in degrees and m/s, so that ours start "
            "fresh, and a clone has to learn them first"
        )
        notes.append(SAC_DIFFERS)
    elif VALUE in absent:
        notes.append(
            "a frozen graph holds only the policy: the value network starts fresh, and a clone has to learn it first"
        )
    if any(name != VALUE for name in absent):
        notes.append(
            "a frozen graph holds no standard deviation of the actions: it starts at network.initial_std"
        )
    return notes
