"""How much worse a policy drives with the physical car's pictures, timing and controls, and with each alone."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import torch
from rich.table import Table

from deepracer_exp.config.evaluation import EvaluationConfig, RealCarConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.deepracer.car_controls import full_scale, throttle
from deepracer_exp.env.action_space import build_action_space, metadata_of

from .evaluator import Evaluator
from .result import NOTHING, USUAL, Evaluation, number

SIMULATOR, CAR = "simulator", "car"
"""Names of what is compared, beside the parts of `RealCarConfig`."""
_PARTS = tuple(field.name for field in fields(RealCarConfig))
CURES = {
    "picture": "pictures (blur, pixel_noise)",
    "timing": "action_delay_steps, observation_dropout",
    "controls": "speed_noise, motor_scale, servo_scale, in part",
}
"""What of `randomization=sim2real` prepares a policy for a part."""


def protocols(config: EvaluationConfig) -> dict[str, EvaluationConfig]:
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


def compare(
    experiment: Experiment, config: EvaluationConfig, policy: torch.nn.Module, of_car: Evaluation
) -> dict[str, Evaluation]:
    """Race the policy in the plain simulator and with each part of the car alone; add `of_car`, with all parts."""
    found = {name: Evaluator(experiment, one)(policy) for name, one in protocols(config).items()}
    return {**found, CAR: of_car}


def key_figures(evaluations: Mapping[str, Evaluation]) -> dict[str, dict[str, Any]]:
    """Return `lap_share`, `completion` (0 to 1) and `lap_time_s` (None on several tracks) of each, JSON types."""
    found = {}
    for name, evaluation in evaluations.items():
        group = evaluation.on(USUAL)
        found[name] = {
            "lap_share": group.lap_share,
            "completion": group.completion / 100,
            "lap_time_s": group.mean_lap_time_s if len(evaluation.tracks) == 1 else None,
        }
    return found


def losses_table(evaluations: Mapping[str, Evaluation]) -> Table:
    """Return what is lost under usual conditions as a table: simulator, each part of the car alone, all of them."""
    found = key_figures(evaluations)
    base = found[SIMULATOR]
    shown = Table(box=None, pad_edge=False, title="from the simulator to the car", title_justify="left")
    for name in ("as on the car", "laps %", "lost %", "done %", "lap s", "lost s"):
        shown.add_column(name, justify="left" if name == "as on the car" else "right", no_wrap=True)
    shown.add_column("in sim2real against it")
    names = {SIMULATOR: "nothing", CAR: "all"}
    for name, one in found.items():
        lap_s, base_s = one["lap_time_s"], base["lap_time_s"]
        lost_s = None if name == SIMULATOR or None in (lap_s, base_s) else lap_s - base_s
        shown.add_row(
            names.get(name, name),
            f"{100 * one['lap_share']:.0f}",
            NOTHING if name == SIMULATOR else f"{100 * (base['lap_share'] - one['lap_share']):.0f}",
            f"{100 * one['completion']:.1f}",
            number(lap_s, 2),
            NOTHING if lost_s is None else f"{lost_s:+.2f}",
            CURES.get(name, ""),
        )
    return shown


def explain_controls(experiment: Experiment, config: EvaluationConfig) -> list[str]:
    """Return what the car makes of the action space, in words."""
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
