"""The whole experiment: one frozen dataclass per group of `conf/`."""

import re
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from .car import CarConfig
from .driving import (
    ActionSpaceConfig,
    EpisodeConfig,
    ObservationConfig,
    RandomizationConfig,
    RewardConfig,
    TrackConfig,
    Tracks,
)
from .evaluation import EvaluationConfig
from .learning import (
    AdaptiveKLLR,
    CNNConfig,
    LRScheduleConfig,
    MLPConfig,
    NetworkConfig,
    OneAlgorithm,
    PPOConfig,
    SACConfig,
)
from .racing import ALONE, RaceConfig
from .running import BudgetConfig, CheckpointsConfig, CollectorConfig, TrackingConfig
from .stopping import ReliableStopping, StoppingConfig


def safe_name(name: str) -> str:
    """Return a name that can be used for folders and files.

    Raises:
        ValueError: it is not.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}", name):
        raise ValueError(
            "a name has letters, digits, '.', '_' and '-', at most 80, and begins with a letter or digit"
        )
    return name


SafeName = Annotated[str, AfterValidator(safe_name)]


def _device(name: str) -> str:
    if not re.fullmatch(r"cpu|cuda(:\d)?", name):
        raise ValueError("no such device; accepted: cpu, cuda, cuda:NUMBER")
    return name


def _read_off(kept: object) -> object:
    """Read YAML's `off`, which YAML takes for false, as the word."""
    return "off" if kept is False else kept


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Everything that defines a run."""

    name: SafeName
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    runs_dir: Annotated[str, Field(min_length=1)]
    debug: bool
    report: bool
    track: Tracks
    car: CarConfig
    action_space: ActionSpaceConfig
    observation: ObservationConfig
    randomization: RandomizationConfig
    episode: EpisodeConfig
    reward: RewardConfig
    network: NetworkConfig
    algorithm: OneAlgorithm
    lr_schedule: LRScheduleConfig
    collector: CollectorConfig
    evaluation: EvaluationConfig
    checkpoints: CheckpointsConfig
    stopping: StoppingConfig
    budget: BudgetConfig
    tracking: TrackingConfig
    race: RaceConfig = ALONE
    device: Annotated[str, AfterValidator(_device)] = "cpu"
    trace: Annotated[Literal["full", "laps", "off"], BeforeValidator(_read_off)] = "full"

    def __post_init__(self) -> None:
        """Refuse groups that contradict each other, such as a network that cannot read the observation."""
        algorithm = self.algorithm
        if isinstance(algorithm, SACConfig):
            self._check_sac()
        stopping = self.stopping
        if isinstance(stopping, ReliableStopping) and stopping.evaluations and self.checkpoints.every is None:
            raise ValueError(
                f"stopping.evaluations={stopping.evaluations}: this training has no evaluations; accepted: null, or a "
                "number of iterations for checkpoints.every"
            )
        if isinstance(stopping, ReliableStopping) and stopping.held_out_completion is not None:
            without = "stopping.evaluations=null" if not stopping.evaluations else "evaluation.held_out=null"
            if not stopping.evaluations or self.evaluation.held_out is None:
                raise ValueError(
                    f"stopping.held_out_completion={stopping.held_out_completion:g}: no evaluation on held-out "
                    f"conditions counts with {without}; accepted: null"
                )
        if self.device != "cpu" and isinstance(algorithm, PPOConfig) and algorithm.target is not None:
            raise ValueError(
                f"device={self.device}: an algorithm of your own chooses where it computes; accepted: device=cpu"
            )
        camera, lidar, network = self.observation.camera, self.observation.lidar, self.network
        if self.race.others and not self.observation.next_objects and camera is None and lidar is None:
            raise ValueError(
                f"observation.next_objects=0: the policy would not see the {self.race.others} others of the race; "
                "accepted: observation.next_objects=2, or observation=camera, lidar, ..."
            )
        if isinstance(network, MLPConfig) and camera is not None:
            raise ValueError(
                "network: reads features, and observation.camera gives pictures; accepted: network=cnn_small, "
                "shallow, medium, deep, attention"
            )
        if isinstance(network, MLPConfig) and lidar is not None:
            raise ValueError(
                "network: reads features, and observation.lidar gives distances; accepted: network=lidar"
            )
        if not isinstance(network, CNNConfig):
            return
        if network.filters and camera is None:
            raise ValueError(
                "network: convolutions need pictures; accepted: observation=camera, or network="
                + ("mlp_small" if lidar is None else "lidar")
            )
        if not network.filters and camera is not None:
            raise ValueError("network.filters=[]: pictures need convolutions; accepted: network=cnn_small")
        if not network.filters and lidar is None:
            raise ValueError("network: reads a LIDAR; accepted: observation=lidar, or network=mlp_small")
        if camera is not None and min(network.outputs(camera.height, camera.width)) < 1:
            raise ValueError(
                f"network.kernels: a picture of {camera.width}x{camera.height} is too small for these layers"
            )
        if camera is not None and lidar is not None and network.lidar_joins_after >= len(network.hidden):
            raise ValueError(
                f"network.lidar_joins_after={network.lidar_joins_after}: of {len(network.hidden)} hidden layers at "
                f"least one comes after; accepted: 0 to {len(network.hidden) - 1}"
            )

    def _check_sac(self) -> None:
        """Refuse values that soft actor-critic does not support."""
        if isinstance(self.lr_schedule, AdaptiveKLLR):
            raise ValueError(
                "lr_schedule=adaptive_kl: follows PPO's change of the policy, which SAC does not measure; accepted: "
                "lr_schedule=constant, linear, cosine, exponential, step, warmup"
            )
        if getattr(self.network, "shared_trunk", False):
            raise ValueError(
                "network.shared_trunk=true: SAC's policy and critics share no layers; accepted: false"
            )

    @property
    def tracks(self) -> dict[str, TrackConfig]:
        """Return the tracks by name, one or several."""
        return self.track if isinstance(self.track, dict) else {self.track.name: self.track}
