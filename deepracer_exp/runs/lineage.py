"""Lineage: the parent of a clone, and the family tree of ancestors and clones."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import Field, TypeAdapter

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.stored import ABSENT, config_differences, describe_differences
from deepracer_exp.env.action_space import build_action_space, describe_actions
from deepracer_exp.errors import BadInput
from deepracer_exp.files import read_json_as

from .run_files import LINEAGE, REWARD, RunRecord, is_run, read_head
from .run_result import RunResult, read_result

_NO_EFFECT = ("runs_dir", "debug", "report", "tracking")
"""Groups without influence on driving."""
_IGNORED = ("name", "code")
_Place = TypeVar("_Place")


@dataclass(frozen=True, kw_only=True)
class Lineage:
    """lineage.json of a clone: where it comes from."""

    parent: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    """Name of the parent's folder."""
    parent_dir: str
    """Absolute path of the parent's folder at that time."""
    parent_run_id: str | None
    """MLflow's id of the parent."""
    checkpoint: Annotated[str, Field(pattern=r"^\d{6,9}$")]
    """The parent's checkpoint."""
    sha256: str
    """Hash of the checkpoint."""
    generation: Annotated[int, Field(ge=1)]
    """1: cloned from a run that is no clone."""
    registered: str | None
    """MODEL@ALIAS, if the parent was given so."""


_ADAPTER = TypeAdapter(Lineage)


def read_lineage(run: Path) -> Lineage | None:
    """Return the lineage of a clone, None for any other run.

    Raises:
        BadInput: the file cannot be read or holds something else.
    """
    return read_json_as(run / LINEAGE, _ADAPTER, "a clone")


def refuse_other_networks(parent: Experiment, clone: Experiment) -> None:
    """Refuse a clone that the parent's networks do not fit.

    Raises:
        BadInput: networks, algorithm, sensors, features or actions differ.
    """
    why = "the parent's networks were made for it; train a new run for another"
    if clone.network != parent.network:
        changed = "; ".join(
            describe_differences(config_differences([vars(parent.network), vars(clone.network)]))
        )
        raise BadInput("network", f"cannot be changed in a clone: {changed}; {why}")
    before, after = (type(run.algorithm).__name__.removesuffix("Config") for run in (parent, clone))
    if before != after:
        raise BadInput("algorithm", f"cannot be changed in a clone: {before} -> {after}; {why}")
    seen_before, seen_after = (
        {name: sensor and vars(sensor) for name, sensor in (("camera", seen.camera), ("lidar", seen.lidar))}
        for seen in (parent.observation, clone.observation)
    )
    if seen_before != seen_after:
        changed = "; ".join(describe_differences(config_differences([seen_before, seen_after])))
        raise BadInput("observation", f"cannot be changed in a clone: {changed}; {why}")
    if clone.observation != parent.observation:
        from deepracer_exp.env.observation import feature_names  # imports MuJoCo

        ours, theirs = feature_names(clone.observation), feature_names(parent.observation)
        odd = ", ".join(sorted(set(ours) ^ set(theirs))) or "the order, or what is looked ahead"
        raise BadInput(
            "observation",
            f"cannot be changed in a clone: {len(theirs)} -> {len(ours)} features ({odd}); {why}",
        )
    acted, acts = (
        describe_actions(build_action_space(experiment.action_space)) for experiment in (parent, clone)
    )
    if acted != acts:
        raise BadInput("action_space", f"cannot be changed in a clone: {acted} -> {acts}; {why}")


@dataclass
class FamilyMember:
    """A run of the family."""

    name: str
    path: Path
    record: RunRecord | None
    """The run's files; None if its folder is gone."""
    lineage: Lineage | None
    """The run's parents; None if it is no clone, or gone."""
    generation: int
    result: RunResult | None
    """The run's result; None if it is not known."""
    children: "list[FamilyMember]" = field(default_factory=list)
    changes: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    """Values that differ from the parent's, by dotted key: the parent's and its own."""

    @property
    def course(self) -> str:
        """Name of the track, or of several."""
        return "" if self.record is None else course_names(self.record.config.get("track"))

    def walk(self) -> "Iterator[FamilyMember]":
        """Return the member and all below it, parents first."""
        yield self
        for child in self.children:
            yield from child.walk()


def family(run: Path, runs_dir: Path) -> FamilyMember:
    """Return the root of a run's family tree.

    Relatives are searched in `runs_dir` and beside the run.

    Raises:
        BadInput: a file of a relative cannot be used, or a run descends from itself.
    """
    places = list(dict.fromkeys([runs_dir.resolve(), run.resolve().parent.parent]))
    lineages: dict[Path, Lineage | None] = {}
    children: dict[Path, set[Path]] = {}

    def parent_of(folder: Path) -> Path | None:
        lineage = lineages[folder] = read_lineage(folder)
        if lineage is None:
            return None
        parent = _parent(lineage, places)
        children.setdefault(parent, set()).add(folder)
        return parent

    for place in places:
        for file in place.glob(f"*/*/{LINEAGE}"):
            parent_of(file.parent.resolve())
    root, seen = run.resolve(), set[Path]()
    while (parent := parent_of(root)) is not None:
        seen.add(root)
        if parent in seen:
            raise BadInput(root / LINEAGE, f"{root.name} descends from itself; nothing can be shown")
        root = parent
    return _grow(root, children, lineages)


def clone_chain(runs: Sequence[Path]) -> list[Path]:
    """Select a run and its clones among runs, the oldest first; an unreadable lineage counts as none.

    The result is of resolved folders.
    """
    generations, parents = dict[Path, int](), dict[Path, Path]()
    for run in map(Path.resolve, runs):
        generations[run] = 0
        with suppress(BadInput):
            if (lineage := read_lineage(run)) is not None:
                generations[run] = lineage.generation
                parents[run] = _parent(lineage, [run.parent.parent])
    related = {run for pair in parents.items() if pair[1] in generations for run in pair}
    return sorted(related, key=lambda run: (generations[run], run))


def best_members(root: FamilyMember) -> dict[int, str]:
    """Return the best of the family on each track and by each measure, by `id`, with these measures.

    If any run was evaluated, only evaluated ones count.
    """
    rated = [(relative, relative.result) for relative in root.walk() if relative.result is not None]
    rated = [pair for pair in rated if pair[1].evaluated] or rated
    groups = _best_of_groups((member.course, member, result) for member, result in rated)
    several = len({course for course, _ in groups}) > 1
    words: dict[int, str] = {}
    for (course, _), (member, result) in groups.items():
        word = "best" + f" on {course}" * several + f" by {result.criterion}"
        words[id(member)] = ", ".join(filter(None, [words.get(id(member)), word]))
    return words


def best_by_generation(root: FamilyMember) -> list[tuple[int, FamilyMember, RunResult]]:
    """Return the best member of each generation on each track and measure; evaluated ones before others."""
    rated = [
        ((member.generation, member.course), member, member.result)
        for member in root.walk()
        if member.result is not None
    ]
    evaluated = {place for place, _, result in rated if result.evaluated}
    groups = _best_of_groups(entry for entry in rated if entry[2].evaluated or entry[0] not in evaluated)
    return [(place[0], *groups[place, measure]) for place, measure in sorted(groups)]


def _best_of_groups(
    members: Iterable[tuple[_Place, FamilyMember, RunResult]],
) -> dict[tuple[_Place, str], tuple[FamilyMember, RunResult]]:
    """Return the best by place and measure, the first of equals."""
    best: dict[tuple[_Place, str], tuple[FamilyMember, RunResult]] = {}
    for place, member, result in members:
        key = place, result.measure
        if key not in best or result.rank > best[key][1].rank:
            best[key] = member, result
    return best


def _parent(lineage: Lineage, places: list[Path]) -> Path:
    """Return the parent's folder: where all runs have moved or were copied to, or where it was."""
    recorded = Path(lineage.parent_dir)
    moved = [place / recorded.parent.name / lineage.parent for place in places]
    return next((path for path in moved if is_run(path)), recorded).resolve()


def _grow(
    root: Path, children: Mapping[Path, set[Path]], lineages: Mapping[Path, Lineage | None]
) -> FamilyMember:
    """Return a member with all that descend from it."""
    below = [_grow(child, children, lineages) for child in sorted(children.get(root, ()))]
    lineage = lineages.get(root)
    record = read_head(root) if is_run(root) else None
    if lineage is not None:
        generation = lineage.generation
    elif record is not None:
        generation = 0
    else:  # it is gone, and may have been a clone
        generation = min(child.generation for child in below) - 1
    for child in below:
        if record is not None and child.record is not None:
            differences = run_differences([record, child.record])
            child.changes = {key: (a, b) for key, (a, b) in differences.items() if key not in _IGNORED}
    result = None if record is None else read_result(root)
    return FamilyMember(root.name, root, record, lineage, generation, result, below)


def run_differences(records: Sequence[RunRecord]) -> dict[str, list[Any]]:
    """Return the values in which the runs differ, by dotted key; ABSENT where a run has no such key.

    The reward function and the code are compared by their hashes.
    """
    configs = [
        {key: value for key, value in record.config.items() if key not in _NO_EFFECT} for record in records
    ]
    courses = [course_names(config.get("track")) for config in configs]
    if len(set(courses)) > 1:  # the points of a track say less than its name
        for config, course in zip(configs, courses, strict=True):
            config["track"] = course
    for config, record in zip(configs, records, strict=True):
        sha256 = record.provenance.get("reward", {}).get("sha256")
        config[REWARD] = ABSENT if sha256 is None else f"sha256 {sha256[:8]}"
        config["code"] = str(record.provenance.get("git_commit") or ABSENT)[:16]
    return config_differences(configs)


def course_names(track: Any) -> str:
    """Return the name of the track of a configuration, or those of several."""
    is_single = isinstance(track, Mapping)
    return str(track["name"]) if is_single and "name" in track else ", ".join(track) if is_single else ABSENT
