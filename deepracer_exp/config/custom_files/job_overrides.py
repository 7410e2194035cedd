"""Translates run.env, or the training_params.yaml of a trained model, into overrides."""

import re
from collections.abc import Iterator, Mapping

from deepracer_exp.aws.models.job_settings import FILE_KEYS, H2B_KEYS, OA_KEYS, JobSettings
from deepracer_exp.aws.worlds.catalogue import find_world, worlds
from deepracer_exp.aws.worlds.routes import runs_clockwise, world_rows
from deepracer_exp.config.overrides import first_given, override_line
from deepracer_exp.errors import BadInput, nearest

from .job_race import race_overrides

_SECOND_CAR = ("HEAD_TO_MODEL", "F1")
"""Types of race against other models, whose number the service reads elsewhere."""
_DEFAULT_ADVANCE = 0.05
"""The service's default, where the start advances and the file gives no amount."""
_NOT_APPLICABLE = {
    r"DR_TRAIN_(MIN_EVAL|BEST|MAX_STEPS|RTF)|MIN_EVAL_TRIALS|BEST_MODEL_METRIC": "not applicable: how the service "
    "evaluates and batches; here values of evaluation, checkpoints and algorithm",
    r"DR_EVAL_": "not applicable: for evaluations; here `deepracer-exp evaluate RUN evaluation=NAME`",
    r"DR_OA_": "not read, because DR_RACE_TYPE is not OBJECT_AVOIDANCE",
    r"DR_H2B_": "not read, because DR_RACE_TYPE is not HEAD_TO_BOT",
    r"": "no effect on a training here: names, colours, places and parts of the service",
}
"""Patterns of keys without effect here, with the reason; the first match counts."""


def job_overrides(job: JobSettings, typed: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """Turn the settings of a training into overrides.

    `typed` has the user's own overrides by key or group, which have priority.

    Returns:
        The overrides, and a line for each key used, not used or not used as it is there, with the reason.

    Raises:
        BadInput: the track is none of the service's, and the user chose no other.
    """
    lines: list[str] = []
    notes: list[str] = []
    winner = first_given(typed, "track", "track.name", "track.file", "track.knots")
    if winner is None:
        lines += _track_lines(job, typed)
    elif job.world:
        notes.append(f"track and direction: not used, because of {winner}")
    advance = job.start_advance
    if job.changes_start is not None:
        advance = (_DEFAULT_ADVANCE if advance is None else advance) if job.changes_start else 0.0
    starts = {"episode.start_advance": advance, "episode.start_offset": job.start_offset}
    for target, value in starts.items():
        if value is not None:
            if (winner := first_given(typed, "episode", target)) is None:
                # A start at the end of the lap is one at its beginning.
                lines.append(override_line(target, value % 1.0 if target.endswith("offset") else value))
            else:
                notes.append(f"{target}={value:g}: not used, because of {winner}")
    race, remarks = race_overrides(job, typed)
    lines += race
    notes += remarks
    if lines:
        notes.insert(0, f"used as {', '.join(lines)}".replace("'", ""))
    return lines, [f"{job.name}: {note}" for note in (*notes, *_remarks(job))]


def _track_lines(job: JobSettings, typed: Mapping[str, str]) -> list[str]:
    world = _world(job)
    lines = [override_line("track", world)] if world is not None else []
    direction = _direction(job, world)
    if direction is not None and "track.direction" not in typed:
        lines.append(override_line("track.direction", direction))
    return lines


def _world(job: JobSettings) -> str | None:
    if job.world is None:
        return None
    variant = "" if job.is_clockwise is None else "_cw" if job.is_clockwise else "_ccw"
    world = find_world(job.world + variant) or find_world(job.world)
    if world is None:
        raise BadInput(
            job.file,
            f"{job.keys['WORLD_NAME']}={job.world[:80]}: no such world{nearest(job.world, worlds())}",
            "a name that `deepracer-exp tracks` lists, or track=NAME beside it",
        )
    return world


def _direction(job: JobSettings, world: str | None) -> str | None:
    if job.alternate:
        return "alternate"
    if job.reverse is not None:
        return "reversed" if job.reverse else "forward"
    if job.is_clockwise is not None and world is not None:
        return "forward" if job.is_clockwise == runs_clockwise(world_rows(world)) else "reversed"
    return None if job.alternate is None else "forward"


def _remarks(job: JobSettings) -> Iterator[str]:
    if job.race_type in _SECOND_CAR:
        alone = "it needs the model of another; here race=head_to_head races against snapshots or another run"
        yield f"{job.keys['RACE_TYPE']}={job.race_type}: not applied: {alone}"
    if job.has_several:
        yield "further workers: not applied: track=[A,B] trains on several tracks"
    if job.randomizes:
        key = job.keys["ENABLE_DOMAIN_RANDOMIZATION"]
        why = "it changes the colours and the light of pictures; here randomization=sim2real does so"
        yield f"{key}=True: not applied: {why}"
    if job.is_pretrained:
        fresh = "the training starts fresh; `deepracer-exp import MODEL` and `clone` continue one"
        yield f"{job.keys['PRETRAINED']}=True: not applied: {fresh}"
    read = {*job.keys.values(), *FILE_KEYS.values(), "TRACK_DIRECTION_CLOCKWISE", *_race_keys(job)}
    unused: dict[str, list[str]] = {}
    for key in job.set_keys:
        if key not in read:
            why = next(why for pattern, why in _NOT_APPLICABLE.items() if re.match(pattern, key))
            unused.setdefault(why, []).append(key)
    for why, keys in unused.items():
        alike: dict[str, list[str]] = {}
        for key in keys:
            alike.setdefault(_beginning(key), []).append(key)
        used = {_beginning(key) for key in read}
        shown = [
            some[0] if len(some) == 1 else f"{'other ' * (start in used)}{start}"
            for start, some in alike.items()
        ]
        yield f"{', '.join(shown)}: {why}"


def _race_keys(job: JobSettings) -> tuple[str, ...]:
    """Return the file's keys about boxes and bots that are read in its type of race."""
    if not job.is_env:
        return (*OA_KEYS, *H2B_KEYS)
    keys = {"OBJECT_AVOIDANCE": OA_KEYS, "HEAD_TO_BOT": H2B_KEYS}.get(job.race_type, {})
    return tuple(keys.values())


def _beginning(key: str) -> str:
    return re.sub(r"^(DR_[A-Z0-9]+_).+", r"\1*", key)
