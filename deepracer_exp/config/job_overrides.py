"""The overrides that run.env, worker-N.env and training_params.yaml stand for."""

import re
from collections.abc import Iterator, Mapping, Sequence

from deepracer_exp.aws.models.job_settings import FILE_KEYS, H2B_KEYS, OA_KEYS, JobSettings
from deepracer_exp.aws.worlds.catalogue import find_world, worlds
from deepracer_exp.aws.worlds.routes import runs_clockwise, world_rows
from deepracer_exp.errors import BadInput, nearest

from .job_race import race_overrides
from .overrides import first_given, key_of, override_line

_SECOND_CAR = ("HEAD_TO_MODEL", "F1")
"""Types of race against models of others; the service takes their number from elsewhere."""
_DEFAULT_ADVANCE = 0.05
"""The service's, where the start changes and the file does not say by how much."""
_NOT_APPLICABLE = {
    r"DR_TRAIN_(MIN_EVAL|BEST|MAX_STEPS|RTF)|MIN_EVAL_TRIALS|BEST_MODEL_METRIC": "not applicable: how the service "
    "evaluates and batches; here values of evaluation, checkpoints and algorithm",
    r"DR_EVAL_": "not applicable: for evaluations; here `deepracer-exp evaluate RUN evaluation=NAME`",
    r"DR_OA_": "not read, because DR_RACE_TYPE is not OBJECT_AVOIDANCE",
    r"DR_H2B_": "not read, because DR_RACE_TYPE is not HEAD_TO_BOT",
    r"": "no effect on a training here: names, colours, places and parts of the service",
}
"""Keys that have no effect here, the first pattern that matches, and why."""


def job_overrides(workers: Sequence[JobSettings], typed: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """Turn the settings of a training into overrides.

    Each simulation worker may have another track; starts are those of the first. `typed` has the user's own overrides
    by key or group, which have priority.

    Returns:
        The overrides, and a line for each key used, not used or not used as it is there, with the reason.

    Raises:
        BadInput: a track is none of the service's, and the user chose no other.
    """
    lines: list[str] = []
    notes: list[str] = []
    if not workers:
        return lines, notes
    first = workers[0]
    files = ", ".join(dict.fromkeys(worker.name for worker in workers))
    winner = first_given(typed, "track", "track.name", "track.file", "track.knots")
    if winner is None:
        lines += _track_lines(workers, typed)
    elif any(worker.world for worker in workers):
        notes.append(f"{files}: track and direction: not used, because of {winner}")
    advance = first.start_advance
    if first.changes_start is not None:
        advance = (_DEFAULT_ADVANCE if advance is None else advance) if first.changes_start else 0.0
    starts = {"episode.start_advance": advance, "episode.start_offset": first.start_offset}
    for target, value in starts.items():
        if value is not None:
            if (winner := first_given(typed, "episode", target)) is None:
                # A start at the end of the lap is one at its beginning.
                lines.append(override_line(target, value % 1.0 if target.endswith("offset") else value))
            else:
                notes.append(f"{first.name}: {target}={value:g}: not used, because of {winner}")
    race, remarks = race_overrides(first, typed)
    lines += race
    notes += [f"{first.name}: {remark}" for remark in remarks]
    if lines:
        notes.insert(0, f"{files}: used as {', '.join(lines)}".replace("'", ""))
    notes += [f"{name}: {what}" for name, what in _remarks(workers)]
    return lines, list(dict.fromkeys(notes))


def several_of(lines: Sequence[str]) -> list[str]:
    """Return those of the overrides that choose several tracks, which no option file can."""
    chosen = [line for line in lines if line.startswith("track=[")]
    return [line for line in lines if key_of(line).partition(".")[0] == "track"] if chosen else []


def _track_lines(workers: Sequence[JobSettings], typed: Mapping[str, str]) -> list[str]:
    directions: dict[str | None, list[str | None]] = {}
    for worker in workers:
        name = _world(worker)
        directions.setdefault(name, []).append(_direction(worker, name))
    if None in directions:  # the track stays what it is
        directions = {None: directions[None]}
    # A track that workers drive in both directions is driven in both by each car.
    each = {name: driven[0] if len(set(driven)) == 1 else "alternate" for name, driven in directions.items()}
    names = [name for name in each if name is not None]
    lines = [override_line("track", names if len(names) > 1 else names[0])] if names else []
    for name, direction in each.items():
        prefix = f"track.{name}" if len(names) > 1 else "track"
        if direction is not None and "track.direction" not in typed:
            lines.append(override_line(f"{prefix}.direction", direction))
        if len(names) > 1 and len(directions[name]) > 1:
            lines.append(override_line(f"{prefix}.weight", len(directions[name])))
    return lines


def _world(worker: JobSettings) -> str | None:
    if worker.world is None:
        return None
    variant = "" if worker.is_clockwise is None else "_cw" if worker.is_clockwise else "_ccw"
    world = find_world(worker.world + variant) or find_world(worker.world)
    if world is None:
        raise BadInput(
            worker.file,
            f"{worker.keys['WORLD_NAME']}={worker.world[:80]}: no such world{nearest(worker.world, worlds())}",
            "a name that `deepracer-exp tracks` lists, or track=NAME beside it",
        )
    return world


def _direction(worker: JobSettings, name: str | None) -> str | None:
    if worker.alternate:
        return "alternate"
    if worker.reverse is not None:
        return "reversed" if worker.reverse else "forward"
    if worker.is_clockwise is not None and name is not None:
        return "forward" if worker.is_clockwise == runs_clockwise(world_rows(name)) else "reversed"
    return None if worker.alternate is None else "forward"


def _remarks(workers: Sequence[JobSettings]) -> Iterator[tuple[str, str]]:
    first = workers[0]
    for worker in workers:
        key = worker.keys["RACE_TYPE"]
        if worker.race_type in _SECOND_CAR:
            alone = (
                "it needs the model of another; here race=head_to_head races against snapshots or another run"
            )
            yield worker.name, f"{key}={worker.race_type}: not applied: {alone}"
        if (worker.race_type, worker.race) != (first.race_type, first.race):
            yield worker.name, f"{key} and boxes or bots: not applied: all cars race as those of {first.name}"
        if (worker.start_advance, worker.start_offset, worker.changes_start) != (
            first.start_advance,
            first.start_offset,
            first.changes_start,
        ):
            yield worker.name, f"starts: not applied: all cars start as those of {first.name}"
    if any(worker.randomizes for worker in workers):
        key = first.keys["ENABLE_DOMAIN_RANDOMIZATION"]
        why = "it changes the colours and the light of pictures; here randomization=sim2real does so"
        yield first.name, f"{key}=True: not applied: {why}"
    if first.is_pretrained:
        fresh = "the training starts fresh; `deepracer-exp import MODEL` and `clone` continue one"
        yield first.name, f"{first.keys['PRETRAINED']}=True: not applied: {fresh}"
    read = {*first.keys.values(), *FILE_KEYS.values(), "TRACK_DIRECTION_CLOCKWISE", *_race_keys(first)}
    unused: dict[str, list[str]] = {}
    for key in dict.fromkeys(key for worker in workers for key in worker.set_keys if key not in read):
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
        yield first.name, f"{', '.join(shown)}: {why}"


def _race_keys(job: JobSettings) -> tuple[str, ...]:
    """Return the file's keys about boxes and bots that are read in its type of race."""
    if not job.is_env:
        return (*OA_KEYS, *H2B_KEYS)
    keys = {"OBJECT_AVOIDANCE": OA_KEYS, "HEAD_TO_BOT": H2B_KEYS}.get(job.race_type, {})
    return tuple(keys.values())


def _beginning(key: str) -> str:
    return re.sub(r"^(DR_[A-Z0-9]+_).+", r"\1*", key)
