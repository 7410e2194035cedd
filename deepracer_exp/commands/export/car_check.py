"""The command `check --car`: predict a policy's driving on the physical car, and whether it is ready."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from deepracer_exp.agents.actor_critic import PolicyNetworks
from deepracer_exp.aws.models.car_archive import describe_commands
from deepracer_exp.aws.models.car_controls import full_scale, throttle
from deepracer_exp.config.evaluation import EvaluationConfig, RealCarConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.action_space import ActionSpace, build_action_space, metadata_of
from deepracer_exp.env.race import Race
from deepracer_exp.env.trace_columns import PACKED, STATUS_CODE
from deepracer_exp.errors import RunFailed, writing
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.film import LapRecorder, best_attempt, png
from deepracer_exp.evaluation.plan import EvaluatePlan
from deepracer_exp.evaluation.race_protocol import RaceProtocol
from deepracer_exp.evaluation.results import USUAL, Evaluation, number
from deepracer_exp.evaluation.run_evaluation import write_evaluation
from deepracer_exp.evaluation.zigzag import CURE, ZIGZAG_DEG, ZIGZAG_PER_M, ZigZag
from deepracer_exp.files import atomic_write
from deepracer_exp.reports.pages.picture_changes import TriedPictures, pictures_sheet, try_pictures
from deepracer_exp.runs.checkpoint_files import checkpoint_words
from deepracer_exp.runs.run_files import FILMS
from deepracer_exp.runs.run_result import RELIABLE

from .car_converter import NEEDED, Conversion, compare_in_openvino, has_openvino
from .car_export import CarArchive, car_archive
from .onnx import DeployedPolicy

SIMULATOR, CAR = "simulator", "car"
"""Names of the compared races, beside the parts of `RealCarConfig`."""
_PARTS = tuple(field.name for field in fields(RealCarConfig))
LEAST_ON_CAR = 0.9
"""Share of complete laps wanted with each part of the car and with all; in the simulator it is `RELIABLE`."""
LEAST_FACTOR = 4.0
"""Least real-time factor here, on one core; the car's processor is slower."""
MOST_BAD = 0.05
"""Share of a lap's pictures that may decide badly."""
LEAST_SAME = 0.99
"""Share of a lap's pictures on which the car's converter must decide as the policy does here."""
_NEAR = 5
"""Percentile of the distance to the road's edge that is shown."""
_TIMED = 20


@dataclass(frozen=True)
class CarLaps:
    """Laps with no part of the car, one of them or all."""

    evaluation: Evaluation
    edge_m: float
    """Distance of the car's front from the nearer edge of the road, below which it is in `_NEAR` % of the steps, m;
    NaN where it did not drive."""


@dataclass(frozen=True)
class CarCheck:
    """Results of the check of a policy for the car."""

    laps: Mapping[str, CarLaps]
    """Without a part of the car, with each, and with all, by the names of `car_protocols` and `CAR`."""
    network_s: float
    """Processor time of one decision here, on one core."""
    frame_s: float
    """Time between two pictures on the car."""
    pictures: TriedPictures
    """The pictures of the best lap with all parts of the car."""
    conversion: Conversion | None
    """Decisions of the car's converter on these pictures; None: it is not installed."""

    @property
    def factor(self) -> float:
        """Return the real-time factor: decisions here in the time between two pictures on the car."""
        return self.frame_s / self.network_s

    @property
    def zigzag(self) -> ZigZag:
        """Return the zig-zag with all parts of the car."""
        return self.laps[CAR].evaluation.on(USUAL).zigzag

    def to_do(self) -> list[str]:
        """Return remedies before the drive, the most important first; empty if the policy is ready."""
        steps = []
        if self.factor < LEAST_FACTOR:
            steps.append(
                f"the network is too slow: real-time factor {self.factor:.1f}, wanted {LEAST_FACTOR:g}; train with "
                "network=cnn_small"
            )
        figures = _car_figures(self.laps)
        shares = {name: figure["lap_share"] for name, figure in figures.items()}
        weak = [name for name in self.laps if name != SIMULATOR and shares[name] < LEAST_ON_CAR]
        if not shares[SIMULATOR]:  # results of such a policy do not apply to a trained one
            return [
                *steps,
                "in the simulator no lap is complete: the policy has not learned to drive; train it for longer "
                "(deepracer-exp resume RUN budget.env_steps=N)",
            ]
        if shares[SIMULATOR] < RELIABLE:
            weak = []  # failures in the simulator itself do not concern the car
            steps.append(
                f"in the simulator {shares[SIMULATOR]:.0%} of the laps are complete, wanted {RELIABLE:.0%}; train "
                "further (deepracer-exp clone)"
            )
        parts = [name for name in weak if name != CAR]
        steps += [
            f"as on the car, {'all parts together' if name == CAR else name}: {shares[name]:.0%} of the laps are "
            f"complete, wanted {LEAST_ON_CAR:.0%}; train with randomization=real_car"
            for name in parts or weak
        ]
        changes_per_m, amplitude_deg = self.zigzag.changes_per_m, self.zigzag.amplitude_deg
        if (changes_per_m or 0.0) >= ZIGZAG_PER_M and (amplitude_deg or 0.0) >= ZIGZAG_DEG:
            steps.append(f"it zig-zags on straights; try {CURE}")
        if self.conversion is not None and self.conversion.same.mean() < LEAST_SAME:
            steps.append(
                f"in OpenVINO, the car's converter, it decides otherwise: {self.conversion.words()}, wanted "
                f"{LEAST_SAME:.0%}; choose another checkpoint (checkpoint=NAME)"
            )
        if self.pictures.bad_share > MOST_BAD:
            steps.append(
                f"{self.pictures.bad_share:.0%} of the pictures decide badly, wanted {MOST_BAD:.0%}; train with the "
                "pictures of randomization=real_car"
            )
        return steps


def car_protocols(config: EvaluationConfig) -> dict[str, EvaluationConfig]:
    """Return the protocol without any part of the real car and with each part alone, by name."""
    assert config.real_car is not None
    none = RealCarConfig(**dict.fromkeys(_PARTS))
    chosen = [name for name in _PARTS if getattr(config.real_car, name) is not None]
    alone = {name: replace(none, **{name: getattr(config.real_car, name)}) for name in chosen}
    # A single part alone is the whole car.
    shown = alone if len(alone) > 1 else {}
    return {
        SIMULATOR: replace(config, real_car=None),
        **{name: replace(config, real_car=real_car) for name, real_car in shown.items()},
    }


def _car_figures(laps: Mapping[str, CarLaps]) -> dict[str, dict[str, Any]]:
    """Return `lap_share`, `completion` (0 to 1) and `lap_time_s` (None on several tracks) of each, JSON types."""
    figures = {}
    for name, driven in laps.items():
        group = driven.evaluation.on(USUAL)
        figures[name] = {
            "lap_share": group.lap_share,
            "completion": group.completion / 100,
            "lap_time_s": group.mean_lap_time_s if len(driven.evaluation.tracks) == 1 else None,
        }
    return figures


def check_run(plan: EvaluatePlan, picture: Path | None, out: Console, err: Console) -> CarCheck:
    """Race a run's checkpoint with the car's camera, timing and controls, and print the results.

    Args:
        plan: of an evaluation with `real_car`.
        picture: file for the pictures that decide badly; None: in the run's folder.
        out: where results are printed.
        err: where progress is printed.

    Raises:
        BadInput: the checkpoint or a track cannot be used, or the car would refuse or misread the policy.
        RunFailed: a car's state became NaN, or a file cannot be written.
    """
    run, config = plan.run, plan.config.evaluation
    assert config.real_car is not None
    stored, experiment = run.read_policy(), run.experiment
    archive = car_archive(stored.networks, experiment)
    torch.set_num_threads(1)
    policy = stored.networks.policy
    err.print(f"{run.path.name}, {checkpoint_words(stored.path.name)}", soft_wrap=True)
    laps = {}
    for name, protocol in {**car_protocols(config), CAR: config}.items():
        err.print(f"  driving {_NAMES.get(name, f'with the {name} of the car')}")
        evaluator = Evaluator(experiment, protocol)
        edges = _Edges(evaluator)
        laps[name] = CarLaps(evaluator(policy, edges), edges.near_m())
    # The race of the whole car is the last one.
    recorder = LapRecorder(evaluator, best_attempt(laps[CAR].evaluation))
    evaluator(policy, recorder)
    car, acted = evaluator.race.setup, recorder.acted
    check = CarCheck(
        laps,
        network_time_s(policy, acted[:1]),
        car.car.control_period_s,
        try_pictures(policy, acted, car.actions),
        _converted(archive, stored.networks, car.actions, acted) if has_openvino() else None,
    )
    results = write_evaluation(run.path, laps[CAR].evaluation, config, stored, _car_figures(laps))
    files = {}
    if len(check.pictures.bad):
        file = picture or run.path / FILMS / f"{stored.path.name}-car.png"
        camera = experiment.observation.camera
        assert camera is not None
        with writing(file, failure=RunFailed):
            file.parent.mkdir(exist_ok=True)
            atomic_write(file, png(pictures_sheet(check.pictures, policy, camera)))
        files["pictures"] = file
    files["results"] = results
    print_check(check, archive, experiment, config, out)
    out.print()
    for name, file in files.items():
        out.print(f"  {name:8}  {file}", soft_wrap=True)
    out.print()
    steps = check.to_do()
    if not steps:
        out.print("ready", style="bold")
    for step in steps:
        # In a pipe, a line for each.
        out.print(f"not ready: {step}", soft_wrap=not out.is_terminal)
    return check


def print_check(
    check: CarCheck, archive: CarArchive, experiment: Experiment, config: EvaluationConfig, out: Console
) -> None:
    """Print the results in tables that fit 80 columns, and in sentences."""

    def say(*lines: str) -> None:
        for line in lines:
            if out.is_terminal:
                out.print(Padding(Text(line), (0, 0, 0, 2), expand=False))
            else:
                out.print(Text(f"  {line}"), soft_wrap=True)

    out.print("What the car makes of the actions, with its maximum speed at 100%:")
    say(*describe_commands(archive.metadata), *archive.notes)
    out.print()
    out.print(laps_table(check.laps))
    say(
        f"edge cm: how near the car's front comes to the road's edge in the nearest {_NEAR}% of the steps; below 0 it "
        "is beyond it"
    )
    out.print()
    out.print(figures_table(check))
    out.print()
    trained_hz = experiment.car.control_hz
    say(
        f"a picture takes {1000 * check.network_s:.2f} ms here on one core, {1000 * check.frame_s:.1f} ms pass between "
        "two on the car",
        f"{1 / check.frame_s:g} actions a second, {trained_hz:g} in the training",
        *_explain_controls(experiment, config),
    )
    if check.conversion is None:
        say(f"the archive was not tried in OpenVINO, the car's converter: {NEEDED}")
    if len(check.pictures.bad):
        say(f"pictures that decide badly, by what changed: {check.pictures.by_change()}")


def _explain_controls(experiment: Experiment, config: EvaluationConfig) -> list[str]:
    """Describe the car's response to the action space."""
    controls = None if config.real_car is None else config.real_car.controls
    if controls is None:
        return []
    actions = build_action_space(experiment.action_space)
    scale = full_scale(metadata_of(actions))
    top_mps = controls.full_throttle_mps or scale.speed_mps
    half_mps = top_mps * float(throttle(0.5 * scale.speed_mps, scale.speed_mps))
    lines = [
        f"steering: {scale.steering_deg:g} degrees are full lock, {controls.full_lock_deg:g} degrees on the car",
        f"speed: {scale.speed_mps:g} m/s are full throttle, {top_mps:g} m/s on the car; half of it becomes "
        f"{half_mps:g} m/s",
    ]
    if 0 < scale.steering_deg != controls.full_lock_deg:
        lines[0] += f": {controls.full_lock_deg / scale.steering_deg:.2g} times as much"
    if -actions.low[0] > scale.steering_deg > 0:
        lines.append(
            f"the servo refuses steering beyond {-scale.steering_deg:g} degrees and keeps the last angle"
        )
    return lines


_NAMES = {SIMULATOR: "in the simulator", CAR: "as on the car"}


def _converted(
    archive: CarArchive, networks: PolicyNetworks, actions: ActionSpace, acted: TensorDict
) -> Conversion:
    """Compare OpenVINO's decisions with the policy's on the observations of n steps, [n]."""
    deployed = DeployedPolicy(networks, actions).eval()
    return compare_in_openvino(archive, deployed, [acted[key] for key in deployed.in_keys])


def laps_table(laps: Mapping[str, CarLaps]) -> Table:
    """Return the laps and margins under each part of the car as a table."""
    shown = Table(box=None, pad_edge=False)
    for name in ("as on the car", "laps %", "wanted", "edge cm", "lap s", "zig-zag /m"):
        shown.add_column(name, justify="left" if name == "as on the car" else "right", no_wrap=True)
    figures = _car_figures(laps)
    names = {SIMULATOR: "nothing", CAR: "all"}
    for name, driven in laps.items():
        wanted = RELIABLE if name == SIMULATOR else LEAST_ON_CAR
        shown.add_row(
            names.get(name, name),
            f"{100 * figures[name]['lap_share']:.0f}",
            f"{100 * wanted:.0f}",
            number(np.round(100 * driven.edge_m) + 0.0, 0),  # not -0
            number(figures[name]["lap_time_s"], 2),
            number(driven.evaluation.on(USUAL).zigzag.changes_per_m, 2),
        )
    return shown


def figures_table(check: CarCheck) -> Table:
    """Return the figures that are not of laps, with their wanted values, as a table."""
    shown = Table(box=None, pad_edge=False)
    for name in ("what", "on the car", "wanted"):
        shown.add_column(name, no_wrap=True)
    shown.add_row("real-time factor", f"{check.factor:.1f}", f"at least {LEAST_FACTOR:g}")
    amplitude_deg = check.zigzag.amplitude_deg
    swings = "" if not amplitude_deg or np.isnan(amplitude_deg) else f", {amplitude_deg:.0f} degrees"
    shown.add_row(
        "zig-zag on straights",
        f"{number(check.zigzag.changes_per_m, 2)} a metre{swings}",
        f"below {ZIGZAG_PER_M:g} or {ZIGZAG_DEG:g} degrees",
    )
    shown.add_row("pictures that decide badly", check.pictures.words(), f"at most {MOST_BAD:.0%}")
    if check.conversion is not None:
        same = check.conversion.same
        shown.add_row(
            "same action in OpenVINO",
            f"{same.sum():,} of {len(same):,} ({same.mean():.0%})",
            f"at least {LEAST_SAME:.0%}",
        )
    return shown


def network_time_s(policy: nn.Module, seen: TensorDict) -> float:
    """Return the processor time of one decision, [1], the least of some: other processes only add to it."""
    times = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(_TIMED):
            begin = time.thread_time()
            policy(seen.clone())
            times.append(time.thread_time() - begin)
    return min(times)


class _Edges:
    """Records how far the cars of an evaluation are from the edges of the road."""

    def __init__(self, evaluator: Evaluator) -> None:
        self._evaluator = evaluator
        self._points: list[NDArray[np.float64]] = []

    def __call__(self, race: Race, protocol: RaceProtocol, acted: TensorDict) -> None:
        """Record one control step of the cars that drive."""
        rows = race.trace[:, _COLUMNS]
        drives = protocol.running & (rows[:, 2] == STATUS_CODE["in_progress"])
        self._points.append(np.column_stack([rows[:, :2], np.where(drives, np.arange(len(rows)), -1)]))

    def near_m(self) -> float:
        """Return the distance below which the cars are in `_NEAR` % of their steps; NaN where none drove."""
        points = np.concatenate(self._points)
        tracks = [course.tracks[0] for course in self._evaluator.race.setup.courses]
        of_car = np.array([trial.course for trial in self._evaluator.trials])
        car = points[:, 2].astype(np.intp)
        distances = []
        for place, track in enumerate(tracks):
            here = points[(car >= 0) & (of_car[car] == place), :2]
            if len(here):
                projected = track.project(here)
                width_m = track.border_distances(here, projected.center).track_width_m
                distances.append(0.5 * width_m - np.abs(projected.offset_m))
        return float(np.percentile(np.concatenate(distances), _NEAR)) if distances else float("nan")


_COLUMNS = [PACKED[name] for name in ("X", "Y", "episode_status")]
