"""Parses plain values into validated, frozen dataclasses; errors name the dotted key."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from deepracer_exp.aws.models.model_metadata import ModelMetadata, read_model_metadata
from deepracer_exp.aws.worlds.catalogue import worlds
from deepracer_exp.errors import BadInput, Unknown, nearest

from .driving import TrackConfig
from .experiment import Experiment
from .learning import PPOConfig
from .own_class import GROUPS, load_class, own_classes

Config = TypeVar("Config")


def parse_experiment(mapping: dict[str, Any]) -> Experiment:
    """Return the experiment that plain values describe; types are strict (no text for numbers, no bool for int).

    Raises:
        BadInput: a key is unknown, missing, of another type or out of its range, or two keys contradict.
    """
    experiment = parse_config(mapping, Experiment)
    _check_combinations(experiment)
    return experiment


def take_over_files(values: dict[str, Any]) -> dict[str, str]:
    """Put what files say into an experiment's values, so that these stay true when a file changes.

    The actions of `action_space.file` replace its path, and a single track of a file is called like the file.

    Returns:
        The display name of the action space; empty where it has no file.

    Raises:
        BadInput: the file of the action space is not a model_metadata.json.
    """
    track, space = values.get("track"), values.get("action_space")
    if isinstance(track, dict) and isinstance(file := track.get("file"), str):
        values["track"] = {**track, "name": Path(file).stem, "title": Path(file).stem}
    file = space.get("file") if isinstance(space, dict) else None
    if not isinstance(file, str):
        return {}
    try:
        metadata = read_model_metadata(file)
    except BadInput as error:
        raise BadInput(f"action_space.file={error}") from None
    values["action_space"] = {**action_space_values(metadata), "file": None}
    return {"action_space": Path(file).stem}


def action_space_values(metadata: ModelMetadata) -> dict[str, Any]:
    """Return the values of the group `action_space` for a model's actions, without `file`."""
    low, high = metadata.low, metadata.high
    if low is None or high is None:
        listed = [
            {"steering_angle": action.steering_deg, "speed": action.speed_mps} for action in metadata.actions
        ]
        return {"kind": "discrete", "actions": listed}
    return {
        "kind": "continuous",
        "steering_angle": {"low": low.steering_deg, "high": high.steering_deg},
        "speed": {"low": low.speed_mps, "high": high.speed_mps},
    }


def parse_config(mapping: dict[str, Any], kind: type[Config]) -> Config:
    """Return the dataclass that plain values describe; types are strict.

    Raises:
        BadInput: a key is unknown, missing, of another type or out of its range, or two keys contradict.
    """
    try:
        # JSON is the strict mode that still takes a YAML list for a tuple and 1 for 1.0.
        adapter: TypeAdapter[Config] = _adapter(kind)  # type: ignore[arg-type]
        return adapter.validate_json(json.dumps(mapping), strict=True, extra="forbid")
    except ValidationError as error:
        raise _first_finding(mapping, error) from error


@cache
def _adapter(kind: type) -> TypeAdapter[Any]:
    # Building an adapter takes longer than ten validations.
    return TypeAdapter(kind)


def _check_combinations(experiment: Experiment) -> None:
    """Refuse values that are accepted one by one but contradict one another."""
    algorithm, collector = experiment.algorithm, experiment.collector
    if (algorithm.frames_per_iteration is None) == (algorithm.episodes_per_iteration is None):
        raise BadInput(
            f"algorithm.frames_per_iteration={algorithm.frames_per_iteration} and "
            f"algorithm.episodes_per_iteration={algorithm.episodes_per_iteration}: set exactly one, the other null"
        )
    frames = algorithm.frames_per_iteration
    if frames is not None and algorithm.batch_size > frames and isinstance(algorithm, PPOConfig):
        raise BadInput(
            f"algorithm.batch_size={algorithm.batch_size} is larger than algorithm.frames_per_iteration={frames}",
            "a minibatch cannot hold more steps than an iteration",
        )
    if frames is not None and frames < collector.cars:
        raise BadInput(
            f"algorithm.frames_per_iteration={frames} is smaller than collector.cars={collector.cars}",
            "each car takes at least one step an iteration",
        )
    if collector.mode == "in_process" and collector.processes not in (None, 1):
        raise BadInput(
            f"collector.processes={collector.processes} with collector.mode=in_process",
            "choose collector=sync for several processes",
        )
    accepted = collector.accepted_processes
    if collector.processes not in (None, *accepted):
        near = sorted(sorted(accepted, key=lambda n: abs(n - (collector.processes or 1)))[:3])
        raise BadInput(
            f"collector.processes={collector.processes} with collector.cars={collector.cars}: every process has as "
            f"many cars as the others, at least 4; accepted: {', '.join(map(str, near))}"
        )
    limit_s, hang_s = experiment.reward.time_limit_s, collector.hang_timeout_s
    if collector.mode != "in_process" and limit_s >= hang_s:
        raise BadInput(
            f"reward.time_limit_s={limit_s:g} is not below collector.hang_timeout_s={hang_s:g}",
            "a worker waiting for its reward function would count as hanging",
        )
    _check_delay(experiment)
    for name, track in experiment.tracks.items():
        key = f"track.{name}" if isinstance(experiment.track, dict) else "track"
        _check_shape(key, track)
    if collector.cars < len(experiment.tracks):
        raise BadInput(
            f"collector.cars={collector.cars} with {len(experiment.tracks)} tracks: every track needs a car; accepted: "
            f"at least {len(experiment.tracks)}"
        )


def _check_delay(experiment: Experiment) -> None:
    """Refuse delays after which a car counts as immobilized before it moves."""
    drawn, still = experiment.randomization, experiment.episode.immobilized_steps
    delay, key = drawn.action_delay_steps[1], "action_delay_steps"
    if drawn.real_car is not None and drawn.real_car.timing is not None:
        late = math.floor(drawn.real_car.timing.latency_s[1] * experiment.car.control_hz)
        delay, key = delay + late, f"{key} with real_car.timing.latency_s" if late else key
    if still and delay + 1 >= still:
        raise BadInput(
            f"randomization.{key} reaches {delay} with episode.immobilized_steps={still}: a car with so long a delay "
            f"counts as immobilized before it moves; accepted: up to {max(0, still - 2)}"
        )


def import_own_classes(experiment: Experiment, groups: Sequence[str] = GROUPS) -> None:
    """Import the classes of the user's own that an experiment has in some groups.

    Raises:
        BadInput: one is named by a stored run only, or cannot be imported.
    """
    for group, target in own_classes(asdict(experiment), groups):
        load_class(target, f"{group}.target")


def _check_shape(key: str, track: TrackConfig) -> None:
    knots, width_m = track.knots, track.width_m
    if (knots is None) != (width_m is None):
        there, missing = ("width_m", "knots") if knots is None else ("knots", "width_m")
        raise BadInput(
            f"{key}.{there} without {key}.{missing}: a track of your own needs both, a world of the service has neither"
        )
    if knots is not None and isinstance(width_m, tuple) and len(width_m) != len(knots):
        raise BadInput(
            f"{key}.width_m has {len(width_m)} values and {key}.knots {len(knots)}: accepted: 1, or as many as knots"
        )
    if knots is None and track.file is None and track.name not in worlds():
        raise BadInput(
            f"{key}.name={track.name}: not a world of the service{nearest(track.name, worlds())}; a track of your own "
            "has knots and width_m, or a file"
        )


def _first_finding(mapping: dict[str, Any], error: ValidationError) -> BadInput:
    finding = error.errors(include_url=False)[0]
    path = [str(part) for part in finding["loc"]]
    absent = finding["type"] == "missing"
    unknown = finding["type"] in ("unexpected_keyword_argument", "extra_forbidden")
    key = _key_of(mapping, path, absent or unknown)
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    if absent:
        return BadInput(key, f"missing{more}")
    if unknown:
        parent = _lookup(mapping, key.split(".")[:-1])
        siblings = [k for k in parent if k != path[-1]] if isinstance(parent, dict) else []
        return Unknown(key, f"no such key{nearest(path[-1], siblings)}; known: {', '.join(siblings)}{more}")
    value = finding.get("input")
    if finding["type"] == "union_tag_invalid":
        context = finding["ctx"]
        kind = context["discriminator"].strip("'")
        return Unknown(
            f"{key}.{kind}={context['tag']}", f"no such {kind}", f"{context['expected_tags']}{more}"
        )
    if finding["type"] == "value_error":
        # The message of a dataclass whose values contradict each other names its keys.
        why = f"{finding['ctx']['error']}{more}"
        return (
            BadInput(key if isinstance(value, dict) else f"{key}={_short(value)}", why)
            if key
            else BadInput(why)
        )
    return BadInput(f"{key}={_short(value)}", f"{finding['msg'][0].lower()}{finding['msg'][1:]}{more}")


def _key_of(mapping: dict[str, Any], path: list[str], ends_in_key: bool) -> str:
    """Return the dotted key of a finding; pydantic also puts the tags of unions into its path.

    `ends_in_key` says whether the last part of the path is a key even if the values do not have it.
    """
    key: list[str] = []
    node: Any = mapping
    for index, part in enumerate(path):
        if isinstance(node, dict) and part in node:
            node = node[part]
        elif isinstance(node, list) and part.isdigit() and int(part) < len(node):
            node = node[int(part)]
        elif index + 1 < len(path) or not ends_in_key:
            continue  # a union's tag
        key.append(part)
    return ".".join(key)


def _lookup(mapping: Any, path: list[str]) -> Any:
    for part in path:
        mapping = mapping[int(part)] if isinstance(mapping, list) else mapping[part]
    return mapping


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
