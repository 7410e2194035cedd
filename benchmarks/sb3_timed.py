"""Stable-Baselines3's PPO and SAC on the same cars for some seconds: what others than itself are compared with.

    python -m benchmarks.sb3_timed --seconds 120 [algorithm=sac] [OVERRIDE...]

As many cars as the experiment has are driven through `DeepRacerVecEnv`, in one thread. The hyperparameters are the
experiment's: of PPO those of `benchmarks.sb3_peer` and the fall of its entropy bonus; of SAC networks, minibatch,
replay, warm-up, gradient steps for each step, discount, temperature, target entropy and the pace of the targets; of
both the learning rate and its schedule. The peer keeps no trace, no metrics, no checkpoints and makes no evaluations.
After `--seconds` its last policy drives the fresh laps of `benchmarks.fresh`, and one line of JSON is printed: `steps`
and `train_s` in all, `reliable_steps` and `reliable_s` until 90% of the last 50 episodes were complete laps, and the
figures of the fresh laps.
"""

import json
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from tensordict import TensorDict, TensorDictBase

from deepracer_exp.agents.schedules import build_schedule
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import MLPConfig, PPOConfig, SACConfig
from deepracer_exp.env.sb3 import DeepRacerVecEnv
from deepracer_exp.env.setup import build_setup
from deepracer_exp.env.trace_columns import STATUS_CODE
from deepracer_exp.evaluation.evaluator import Evaluator

from .fresh import TRIALS, driven, fresh_trials
from .report import benchmark_parser
from .sb3_peer import ACTIVATIONS
from .sb3_peer import build as build_ppo

EPISODES, LAP_SHARE = 50, 0.9
"""Episodes of which this share must be complete laps for a policy to be reliable, as `stopping=reliable` has it."""


class Watch(BaseCallback):
    """Ends the training in time, lowers PPO's entropy bonus, and notes when the policy became reliable."""

    def __init__(self, seconds: float, algorithm: PPOConfig | SACConfig) -> None:
        super().__init__()
        self.seconds, self._algorithm, self._last = seconds, algorithm, deque[bool](maxlen=EPISODES)
        self.began = time.perf_counter()
        self.reliable_steps: int | None = None
        self.reliable_s: float | None = None

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.began

    @property
    def share(self) -> float:
        """Share of the seconds that is over, at most 1."""
        return min(1.0, self.elapsed_s / self.seconds)

    def _on_training_start(self) -> None:
        self.began = time.perf_counter()

    def _on_step(self) -> bool:
        ends = [info for info in self.locals["infos"] if info]
        self._last.extend(info["episode_status"] == STATUS_CODE["lap_complete"] for info in ends)
        return self.elapsed_s < self.seconds

    def _on_rollout_end(self) -> None:
        reliable = len(self._last) == EPISODES and sum(self._last) >= LAP_SHARE * EPISODES
        if reliable and self.reliable_s is None:
            self.reliable_steps, self.reliable_s = self.num_timesteps, self.elapsed_s
        if isinstance(self._algorithm, PPOConfig):
            # Stable-Baselines3 has no schedule for it.
            end = self._algorithm.entropy_end_factor
            self.model.ent_coef = self._algorithm.entropy_coeff * (1 + (end - 1) * self.share)


class LikeliestActions(torch.nn.Module):
    """The peer's policy as our evaluations ask it: reads `observation`, writes `action`."""

    def __init__(self, peer: PPO | SAC) -> None:
        super().__init__()
        self.peer = peer

    def forward(self, seen: TensorDictBase) -> TensorDictBase:
        """Return the actions."""
        actions, _ = self.peer.predict(seen["observation"].numpy(), deterministic=True)
        return TensorDict({"action": torch.from_numpy(actions)}, seen.batch_size)


def build_sac(experiment: Experiment, learning_rate: Callable[[float], float]) -> SAC:
    """Return the peer with the experiment's hyperparameters."""
    algorithm, network = experiment.algorithm, experiment.network
    assert isinstance(algorithm, SACConfig)
    assert isinstance(network, MLPConfig)
    assert algorithm.frames_per_iteration is not None
    n_cars = experiment.collector.cars
    periods = -(-algorithm.frames_per_iteration // n_cars)
    sizes = {key: list(network.hidden) for key in ("pi", "qf")}
    layers: dict[str, Any] = {"net_arch": sizes, "activation_fn": ACTIVATIONS[network.activation]}
    return SAC(
        "MlpPolicy",
        DeepRacerVecEnv(n_cars, threads=1, setup=build_setup(experiment)),
        learning_rate=learning_rate,
        buffer_size=algorithm.replay_steps,
        learning_starts=algorithm.warmup_steps,
        batch_size=algorithm.batch_size,
        tau=algorithm.tau,
        gamma=algorithm.discount,
        train_freq=periods,
        gradient_steps=max(1, round(periods * n_cars / algorithm.steps_per_gradient_step)),
        ent_coef=f"auto_{algorithm.alpha}" if algorithm.learn_alpha else algorithm.alpha,
        target_entropy=algorithm.target_entropy,
        policy_kwargs=layers,
        seed=experiment.seed,
        device="cpu",
    )


def measure(experiment: Experiment, seconds: float, trials: int = TRIALS) -> dict[str, float | None]:
    """Train for some seconds and drive fresh laps."""
    torch.set_num_threads(1)
    algorithm, schedule = experiment.algorithm, build_schedule(experiment.lr_schedule)
    assert isinstance(algorithm, PPOConfig | SACConfig)
    watch = Watch(seconds, algorithm)

    def learning_rate(_: float) -> float:
        return algorithm.lr * schedule.factor(0, watch.share)

    peer = (
        build_sac(experiment, learning_rate)
        if isinstance(algorithm, SACConfig)
        else build_ppo(experiment, physics_threads=1, learning_rate=learning_rate)
    )
    peer.learn(10**12, callback=watch, log_interval=None)
    train_s = watch.elapsed_s
    peer.env.close()
    evaluation = Evaluator(experiment, fresh_trials(trials))(LikeliestActions(peer))
    return {
        "steps": peer.num_timesteps,
        "train_s": round(train_s, 3),
        "reliable_steps": watch.reliable_steps,
        "reliable_s": None if watch.reliable_s is None else round(watch.reliable_s, 3),
        **driven(evaluation).figures(),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("sb3_timed", __doc__, json=False)
    parser.add_argument("--seconds", type=float, help="of training", required=True)
    args = parser.parse_args(arguments)
    print(json.dumps(measure(compose_experiment(args.overrides)[0], args.seconds)))


if __name__ == "__main__":
    main()
