"""Control steps per second, from bare physics to a whole training, each beside what it is compared with.

    python -m benchmarks.throughput [--seconds 3] [--rounds 7] [--cars 256] [--json FILE] [OVERRIDE...]

A step is one control step (1/15 s) of one car. Everything is the default experiment unless overridden; physics and
environment are measured with cars that are alike (`randomization=none`).

- `physics_steps_per_s`: `CarBatch.drive` alone, tyres and MuJoCo, one thread, 256 cars. It gets exactly the commands
  and starts of the next figure's driving and is checked to end in the same state; only the time inside the call
  counts.
- `env_steps_per_s`: `RaceEnv`, one thread, 256 cars, random actions drawn beforehand, a scalar reward function (the
  experiment's without its `reward_batch`), episodes begun again as they end.
- `all_tracks_over_one_env` (a ratio): the same on eighteen tracks at once, over the figure on one track.
- `collect_steps_per_s`: batches of an iteration's frames through `Collector` in sync mode with 1 and 2 worker
  processes, the experiment's cars, its network sampling actions with its first weights.
- `train_steps_per_s`: `deepracer-exp train` as a process of its own without MLflow: collection, update, trace, metrics,
  checkpoints. Start-up and the first iteration are left out: env_steps over wall_clock_s between the first and the
  last line of metrics.jsonl.
- `peer_sb3_train_steps_per_s`: see `benchmarks.sb3_peer`; the same number of iterations from the same start, with one
  physics thread per core, and with one torch thread and one per core, the faster of which counts.
- `peer_sb3_default_train_steps_per_s`: the same with the vector environment's own default of one physics thread.
- `car_racing_train_steps_per_s`, with a camera: the peer on Gymnasium's CarRacing-v3, one iteration of
  CAR_RACING_FRAMES a round.

What is compared is measured in turns, `--rounds` times, each for at least `--seconds` (a training for as many
iterations as collection alone would do in that time; from pictures two, whose updates take far longer). Figures are
medians over the rounds; a ratio is the median of the rounds' ratios.
"""

import ast
import dataclasses
import functools
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from deepracer_exp.collectors.collector import Collector
from deepracer_exp.collectors.forking import start_workers_early
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.driving import RewardConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.race import Race
from deepracer_exp.env.race_env import RaceEnv
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.rewards.source import load_reward_source, source_with_constants
from deepracer_exp.runs.checkpoints import networks_of
from deepracer_exp.sim.batch import CarBatch, cores

from .all_tracks import TRACKS
from .command import read_metrics, run_benchmark, train
from .report import benchmark_parser, machine, number, table, write_json

PASS_STEPS = 150
"""Control steps of one pass: 10 s, several episodes of random driving."""
CAR_RACING_FRAMES = 1024
"""Of an iteration on CarRacing-v3, which takes as long as some ten thousand steps here."""

Rates = dict[str, list[float]]
"""Steps per second of each round, by figure."""

RATIOS = (
    ("env_to_physics", "env", "physics", 0.75),
    ("all_tracks_over_one_env", "env, all tracks", "env", 0.85),
    ("collect_2_to_1", "collect 2", "collect 1", 1.6),
    ("train_to_peer", "train", "peer", 1.5),
    ("train_to_default_peer", "train", "peer, 1 physics and 1 torch threads", None),
    ("train_to_car_racing", "train", "CarRacing-v3", 10.0),
)
"""Name, numerator, denominator and the least wanted."""


def peer_name(physics_threads: int, torch_threads: int) -> str:
    """Return what a peer's figures are called."""
    return f"peer, {physics_threads} physics and {torch_threads} torch threads"


def in_turns(rounds: int, seconds: float, passes: dict[str, Callable[[], tuple[float, float]]]) -> Rates:
    """Run each pass in every round for `seconds`; a pass returns its steps and seconds."""
    rates: Rates = {name: [] for name in passes}
    for _ in range(rounds):
        for name, one_pass in passes.items():
            steps = spent = 0.0
            while spent < seconds or not steps:
                more_steps, more_spent = one_pass()
                steps, spent = steps + more_steps, spent + more_spent
            rates[name].append(steps / spent)
    return rates


def scalar_setup(experiment: Experiment) -> RaceSetup:
    """Return what the experiment's cars need, with a reward function that is called once per car."""
    source = load_reward_source(experiment.reward)
    tree = ast.parse(source_with_constants(source))
    tree.body = [
        node for node in tree.body if not (isinstance(node, ast.FunctionDef) and node.name == "reward_batch")
    ]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{source.name}.py"
        file.write_text(ast.unparse(tree), encoding="utf-8")
        time_limit_s = experiment.reward.time_limit_s
        reward = RewardConfig(name=source.name, file=str(file), constants={}, time_limit_s=time_limit_s)
        return build_setup(dataclasses.replace(experiment, reward=reward))


class SameDriving:
    """One pass of random driving that can be timed with the whole environment and with the physics alone.

    The same cars do the same both times: the actions are drawn beforehand, the race begins again from its seed, and
    every step of the bare physics starts from the state in which the environment's began.
    """

    def __init__(self, experiment: Experiment, n_cars: int):
        """Drive the pass once to record each step's state."""
        setup = scalar_setup(experiment)
        self._env = RaceEnv(Race(setup, n_cars, threads=1))
        torch.manual_seed(experiment.seed)
        self._actions = [self._env.action_spec.rand() for _ in range(PASS_STEPS)]
        race = self._env.race
        self._cars = race._batch
        noting = _Noting(self._cars)
        race._batch = noting  # type: ignore[assignment]
        self.env_pass_s()
        race._batch = self._cars
        self._noted, self._last = noting.noted, noting.after

    @property
    def car_steps(self) -> int:
        """Control steps of one pass over all cars."""
        return PASS_STEPS * self._env.race.n_cars

    def env_pass_s(self) -> float:
        """Return the seconds of the pass in the environment, new episodes included."""
        self._env.race.seed(self._env.race.setup.seed)
        root = self._env.reset()
        began = time.perf_counter()
        for action in self._actions:
            root.set("action", action)
            _, root = self._env.step_and_maybe_reset(root)
        return time.perf_counter() - began

    def physics_pass_s(self) -> float:
        """Return the seconds of the pass inside `CarBatch.drive` alone.

        Raises:
            AssertionError: the cars did not end where the environment's did.
        """
        seconds = 0.0
        for before, command in self._noted:
            self._cars.state = before
            began = time.perf_counter()
            self._cars.drive(*command)
            seconds += time.perf_counter() - began
        assert np.array_equal(self._cars.state, self._last), (
            "the physics drove another way than the environment"
        )
        return seconds


class _Noting:
    """Cars that record the state in which each step begins, its command, and the state after the last step."""

    def __init__(self, cars: CarBatch):
        self._cars = cars
        self.noted: list[tuple[np.ndarray, tuple[np.ndarray, ...]]] = []
        self.after: np.ndarray

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cars, name)

    def drive(self, speed_mps: np.ndarray, steering_rad: np.ndarray, moving: np.ndarray) -> None:
        command = speed_mps.copy(), steering_rad.copy(), moving.copy()
        self.noted.append((self._cars.state, command))
        self._cars.drive(*command)
        self.after = self._cars.state


def driving(overrides: Sequence[str], n_cars: int, rounds: int, seconds: float) -> Rates:
    """Measure physics and environment, and the environment on all tracks."""
    # Cars that differ become others with each episode, which the physics alone would not see.
    alike = ("randomization=none", *overrides)
    same = SameDriving(compose_experiment(alike)[0], n_cars)
    everywhere = SameDriving(
        compose_experiment([*alike, f"track=[{','.join(TRACKS)}]", f"collector.cars={n_cars}"])[0], n_cars
    )
    return in_turns(
        rounds,
        seconds,
        {
            "physics": lambda: (same.car_steps, same.physics_pass_s()),
            "env": lambda: (same.car_steps, same.env_pass_s()),
            "env, all tracks": lambda: (everywhere.car_steps, everywhere.env_pass_s()),
        },
    )


def collecting(experiment: Experiment, rounds: int, seconds: float, folder: Path) -> Rates:
    """Measure collection with one and two processes, whose workers wait while it is not their turn."""
    frames = experiment.algorithm.frames_per_iteration
    assert frames is not None, "an iteration must be counted in frames"
    setup = build_setup(experiment)
    policy = networks_of(experiment, torch.Generator().manual_seed(experiment.seed)).policy

    def start(processes: int) -> Collector:
        config = dataclasses.replace(experiment.collector, mode="sync", processes=processes)
        run_dir = folder / f"collect_{processes}"
        run_dir.mkdir()
        return Collector(config, setup, policy, frames, run_dir)

    with start(1) as one, start(2) as two:
        passes: dict[str, Callable[[], tuple[float, float]]] = {}
        for name, collection in (("collect 1", one), ("collect 2", two)):
            collection.next_batch()  # imports, compilation and the first episodes' common start

            def one_batch(batches: Collector = collection) -> tuple[float, float]:
                began = time.perf_counter()
                steps = batches.next_batch().numel()
                return steps, time.perf_counter() - began

            passes[name] = one_batch
        return in_turns(rounds, seconds, passes)


def training(overrides: Sequence[str], iterations: int, rounds: int, folder: Path) -> Rates:
    """Measure training and peer."""
    fixed = ["stopping=none", "tracking=off", "budget.env_steps=null", "budget.minutes=null"]

    def ours() -> tuple[float, float]:
        rows = read_metrics(train([*overrides, *fixed, f"budget.iterations={iterations + 1}"], folder))
        first, last = rows[0], rows[-1]
        return last["env_steps"] - first["env_steps"], last["wall_clock_s"] - first["wall_clock_s"]

    def peer(physics_threads: int, torch_threads: int, car_racing: bool = False) -> tuple[float, float]:
        words = [*overrides]
        if car_racing:
            words += [f"algorithm.frames_per_iteration={CAR_RACING_FRAMES}", "--car-racing"]
        words += ["--iterations", "1" if car_racing else str(iterations)]
        words += ["--physics-threads", str(physics_threads), "--torch-threads", str(torch_threads)]
        result = run_benchmark("sb3_peer", *words)
        return result["env_steps"], result["seconds"]

    passes: dict[str, Callable[[], tuple[float, float]]] = {"train": ours}
    for threads in sorted({(1, 1), (cores(), 1), (cores(), cores())}):
        passes[peer_name(*threads)] = functools.partial(peer, *threads)
    if compose_experiment(overrides)[0].observation.camera is not None:
        passes["CarRacing-v3"] = functools.partial(peer, cores(), cores(), True)
    return in_turns(rounds, 0.0, passes)


def summarize(rates: Rates) -> dict[str, Any]:
    """Return the documented figures: medians, ratios, and the rounds they come from."""
    full = {(cores(), torch_threads) for torch_threads in (1, cores())}
    fastest = max(full, key=lambda threads: statistics.median(rates[peer_name(*threads)]))
    rates = {**rates, "peer": rates[peer_name(*fastest)]}
    middle = {name: round(statistics.median(values), 1) for name, values in rates.items()}
    ratios = {}
    for name, above, below, wanted in RATIOS:
        if below not in rates:  # only learning from pictures is compared with CarRacing-v3
            continue
        by_round = [a / b for a, b in zip(rates[above], rates[below], strict=True)]
        ratios[name] = {
            "median": round(statistics.median(by_round), 3),
            "min": round(min(by_round), 3),
            "max": round(max(by_round), 3),
            "wanted": wanted,
        }
    return {
        "physics_steps_per_s": middle["physics"],
        "env_steps_per_s": middle["env"],
        "collect_steps_per_s": {"1": middle["collect 1"], "2": middle["collect 2"]},
        "train_steps_per_s": middle["train"],
        "peer_sb3_train_steps_per_s": middle["peer"],
        "peer_sb3_default_train_steps_per_s": middle[peer_name(1, 1)],
        "car_racing_train_steps_per_s": middle.get("CarRacing-v3"),
        "peer_torch_threads": fastest[1],
        "ratios": ratios,
        "rounds": {name: [round(rate, 1) for rate in values] for name, values in rates.items()},
    }


def show(summary: dict[str, Any]) -> str:
    """Return the figures and ratios as two tables."""
    figures = [
        (name, number(statistics.median(values)), number(min(values)), number(max(values)))
        for name, values in summary["rounds"].items()
        if name != "peer"
    ]
    ratios = [
        (
            f"{above} / {below}",
            *(number(summary["ratios"][name][key], 2) for key in ("median", "min", "max")),
            "" if wanted is None else number(wanted, 2),
        )
        for name, above, below, wanted in RATIOS
        if name in summary["ratios"]
    ]
    return "\n\n".join(
        (
            table(("steps/s", "median", "min", "max"), figures),
            table(("ratio", "median", "min", "max", "wanted, at least"), ratios),
        )
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("throughput", __doc__)
    parser.add_argument("--seconds", type=float, default=3.0, help="of each figure in each round")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--cars", type=int, default=256, help="of physics_steps_per_s and env_steps_per_s")
    args = parser.parse_args(arguments)
    experiment, _ = compose_experiment(args.overrides)
    start_workers_early(True)  # as the command does
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rates = driving(args.overrides, args.cars, args.rounds, args.seconds)
        rates |= collecting(experiment, args.rounds, args.seconds, folder)
        frames = experiment.algorithm.frames_per_iteration or 0
        iterations = max(2, round(args.seconds * statistics.median(rates["collect 2"]) / frames))
        if experiment.observation.camera is not None:
            iterations = 2
        rates |= training(args.overrides, iterations, args.rounds, folder)
    summary = summarize(rates)
    print(f"{machine()['cores']} cores, {args.rounds} rounds, {iterations} timed iterations a training\n")
    print(show(summary))
    settings = {"cars": args.cars, "seconds": args.seconds, "iterations": iterations}
    write_json(args.json, {**summary, "settings": settings, "overrides": args.overrides})


if __name__ == "__main__":
    main()
