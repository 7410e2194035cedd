"""Stable-Baselines3's PPO on the same cars: what `benchmarks.throughput` compares the training with.

    python -m benchmarks.sb3_peer --iterations 20 [--physics-threads 0] [--torch-threads 1] [--car-racing] [OVERRIDE...]

As many cars as the experiment has are driven through `DeepRacerVecEnv`, by default with one
physics thread per core. Networks, batch size, epochs, frames per iteration, learning rate, discount and loss weights
are the experiment's. The peer keeps no trace, no metrics and no checkpoints. One iteration is made before the clock
starts; then `--iterations` are timed, collection and update, and the result is printed as one line of JSON.

With a camera it is the peer's `CnnPolicy` with the experiment's convolutions, which policy and value share, as is usual
there; a value network of features beside pictures is not. `--car-racing` trains it on Gymnasium's CarRacing-v3 instead
(96x96 in colour, its discrete actions), with one process per core.
"""

import json
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import CNNConfig, MLPConfig, PPOConfig
from deepracer_exp.env.sb3 import DeepRacerVecEnv
from deepracer_exp.env.setup import build_setup
from deepracer_exp.sim.batch import cores

from .report import benchmark_parser

ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU, "elu": torch.nn.ELU, "silu": torch.nn.SiLU}


class Convolutions(BaseFeaturesExtractor):
    """The experiment's layers for pictures."""

    def __init__(self, observation_space: spaces.Box, network: CNNConfig) -> None:
        super().__init__(observation_space, network.hidden[-1])
        channels, height, width = observation_space.shape
        layers: list[torch.nn.Module] = []
        for filters, kernel, stride in zip(network.filters, network.kernels, network.strides, strict=True):
            layers += [torch.nn.Conv2d(channels, filters, kernel, stride), ACTIVATIONS[network.activation]()]
            channels = filters
        units = channels * math.prod(network.outputs(height, width))
        layers.append(torch.nn.Flatten())
        for hidden in network.hidden:
            layers += [torch.nn.Linear(units, hidden), ACTIVATIONS[network.activation]()]
            units = hidden
        self.layers = torch.nn.Sequential(*layers)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        features: torch.Tensor = self.layers(observations)
        return features


def build(
    experiment: Experiment,
    physics_threads: int,
    car_racing: bool = False,
    learning_rate: Callable[[float], float] | None = None,
) -> PPO:
    """Return the peer with the experiment's hyperparameters; `learning_rate` None: it stays as it begins."""
    algorithm, network = experiment.algorithm, experiment.network
    assert isinstance(algorithm, PPOConfig)
    assert algorithm.frames_per_iteration is not None
    n_cars = experiment.collector.cars
    layers: dict[str, Any]
    if isinstance(network, MLPConfig):
        sizes = {key: list(network.hidden) for key in ("pi", "vf")}
        policy, layers = "MlpPolicy", {"net_arch": sizes, "activation_fn": ACTIVATIONS[network.activation]}
    else:
        assert isinstance(network, CNNConfig)
        given = {"features_extractor_kwargs": {"network": network}}
        policy, layers = "CnnPolicy", {"net_arch": [], "features_extractor_class": Convolutions, **given}
    cars: VecEnv
    if car_racing:
        n_cars = cores()
        cars = make_vec_env(
            "CarRacing-v3", n_cars, env_kwargs={"continuous": False}, vec_env_cls=SubprocVecEnv
        )
    else:
        cars = DeepRacerVecEnv(n_cars, threads=physics_threads, setup=build_setup(experiment))
    return PPO(
        policy,
        cars,
        learning_rate=learning_rate or algorithm.lr,
        n_steps=-(-algorithm.frames_per_iteration // n_cars),
        batch_size=algorithm.batch_size,
        n_epochs=algorithm.epochs,
        gamma=algorithm.discount,
        gae_lambda=algorithm.gae_lambda,
        clip_range=algorithm.clip_epsilon,
        ent_coef=algorithm.entropy_coeff,
        vf_coef=algorithm.critic_coeff,
        max_grad_norm=algorithm.max_grad_norm or float("inf"),
        policy_kwargs=layers,
        seed=experiment.seed,
        device="cpu",
    )


def measure(
    experiment: Experiment,
    iterations: int,
    physics_threads: int,
    torch_threads: int,
    car_racing: bool = False,
) -> dict[str, float]:
    """Train for one iteration, then for `iterations` with the clock running."""
    torch.set_num_threads(torch_threads)
    peer = build(experiment, physics_threads, car_racing)
    frames = peer.n_steps * peer.n_envs
    peer.learn(frames, log_interval=None)
    began = time.perf_counter()
    peer.learn(iterations * frames, log_interval=None, reset_num_timesteps=False)
    seconds = time.perf_counter() - began
    peer.env.close()
    return {
        "env_steps": iterations * frames,
        "seconds": seconds,
        "steps_per_s": iterations * frames / seconds,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("sb3_peer", __doc__, json=False)
    parser.add_argument("--iterations", type=int, required=True)
    parser.add_argument("--physics-threads", type=int, default=0, help="0: one per core")
    parser.add_argument("--torch-threads", type=int, default=1)
    parser.add_argument(
        "--car-racing", action="store_true", help="on Gymnasium's CarRacing-v3, not on our cars"
    )
    args = parser.parse_args(arguments)
    experiment, _ = compose_experiment(args.overrides)
    threads = args.physics_threads, args.torch_threads
    print(json.dumps(measure(experiment, args.iterations, *threads, args.car_racing)))


if __name__ == "__main__":
    main()
