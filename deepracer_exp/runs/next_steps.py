"""The results of a run, and next steps as commands to paste."""

import contextlib
import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from deepracer_exp.config.own_class import GROUPS, OF_POLICY, named_again
from deepracer_exp.errors import BadInput
from deepracer_exp.tracks.boards import standings, what_it_sees

from .best_run import best_of
from .folder import is_held
from .run_files import (
    BEST,
    CHECKPOINTS,
    LINEAGE,
    METRICS,
    RunRecord,
    full_name,
    is_randomized,
    read_config,
    read_metrics,
    sees_pictures,
)
from .run_result import FAILED, FIGURES, INTERRUPTED, Ending, fastest_reliable, read_result, why_not_fastest

COMMAND = "deepracer-exp"
SECOND_PHASE = "randomization=sim2real budget.env_steps=1000000"
"""Overrides of a clone that turns a fast policy into a stable one."""
FURTHER = "train it further, at a tenth of the learning rate"
STABLE = "make it stable: train it further on changing conditions, at a tenth of the learning rate"
_RUNS = Path("runs")
"""The default folder of runs in commands."""


def outcome(run: RunRecord) -> list[tuple[str, str]]:
    """Return the amount of driving, the best policy's evaluation and the run's state, as names and values.

    Raises:
        BadInput: its summary.json is not what a training writes.
    """
    tracks, reward = run.config.get("track") or {}, run.config.get("reward") or {}
    listed = [tracks] if "title" in tracks else tracks.values()
    names = [
        f"{track.get('title')}, {track.get('direction', 'forward')}"
        for track in listed
        if isinstance(track, Mapping)
    ]
    facts = [
        ("Track", "; ".join(name.removesuffix(", forward") for name in names)),
        ("Reward", str(reward.get("name") or reward.get("file"))),
    ]
    result = read_result(run.path)
    if result is not None and result.evaluated:
        figures = [(result.figure(name), getattr(result, key), form) for name, key, form, _ in FIGURES]
        facts += [
            (f"{name[0].upper()}{name[1:]}", form.format(value))
            for name, value, form in figures
            if value is not None
        ]
        facts.append(("Best checkpoint", f"{result.iteration}, by {result.criterion}"))
        with contextlib.suppress(BadInput):  # a page is written of a run whose metrics are damaged, too
            rows = run.rows or read_metrics(run.path / METRICS)
            crash_free = [row.get("eval_crash_free") for row in rows if row["iteration"] == result.iteration]
            if crash_free and crash_free[0] is not None:
                facts.insert(2, ("Usual laps without a crash, %", f"{100 * crash_free[0]:.0f}"))
            if (lap := fastest_reliable(rows)) is not None:
                facts.append(("Fastest reliable lap", str(lap)))
            if (why := why_not_fastest(result, rows)) is not None:
                facts.append(("Why it is not the best", why))
    elif run.summary:
        facts.append(("Evaluated", "never"))
    return [*facts, ("State", state(run))]


def official_place(run: RunRecord) -> str | None:
    """Return in words the rank of the mean evaluated lap on the official board of a run's track.

    None: there is no complete lap, the run has several tracks or others on the road, its laps are those of the physical
    car, or its track has no board or is driven the other way.

    Raises:
        BadInput: as for `outcome`.
    """
    config, result = run.config, read_result(run.path)
    mean_lap_s = result.lap_time_s if result is not None and result.evaluated else None
    track, protocol = config.get("track") or {}, config.get("evaluation") or {}
    alone = track.get("direction") == "forward" and track.get("file") is None and track.get("knots") is None
    race = config.get("race") or {}
    others = [race.get(kind) or {} for kind in ("boxes", "bots")]
    alone = alone and not any(some.get("number") or some.get("positions") for some in others)
    alone = alone and race.get("rivals") is None and protocol.get("race") is None
    if mean_lap_s is None or not alone or protocol.get("tracks") is not None or protocol.get("real_car"):
        return None
    observation, penalty_s = config.get("observation") or {}, protocol.get("penalty_s") or {}
    places = standings(
        str(track.get("name")),
        mean_lap_s=mean_lap_s,
        best_lap_s=None,
        car=str((config.get("car") or {}).get("name")),
        sees=what_it_sees(observation.get("camera"), observation.get("lidar")),
        off_track_penalty_s=penalty_s.get("off_track") if protocol.get("resets_per_lap") else None,
    )
    return places[0].words if places else None


def state(run: RunRecord) -> str:
    """Return whether a run is running, was killed, or how it ended."""
    if (ending := Ending.stored(run.summary)) is not None:
        return str(ending)
    return "running" if is_held(run.path) else "killed"


def next_steps(run: Path, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return commands for a run folder with its summary.json, each with its purpose, the first to be used first."""
    word, name, config = run_word(run), own_word(run), read_config(run)
    resume, clone = command_line("resume", name, config), command_line("clone", word, config)
    # A clone has had its second phase; a policy for changing conditions alone, or for the real car, needs none.
    met_all = is_randomized(config) or bool((config.get("randomization") or {}).get("real_car"))
    is_first = not (run / LINEAGE).exists() and not met_all
    steps = []
    if summary["iteration"]:
        evaluate = command_line("evaluate", word, config, OF_POLICY)
        film = (f"{evaluate} --video lap.mp4", "film its fastest usual lap")
        if sees_pictures(config):
            film = (command_line("watch", word, config, OF_POLICY), "film what it sees, and where it looks")
        steps += [
            (evaluate, "race the best checkpoint"),
            film,
            (f"{clone} {SECOND_PHASE}", STABLE) if is_first else (clone, FURTHER),
        ]
        best, fastest = ((run / CHECKPOINTS / label).resolve() for label in ("best", "fastest"))
        if fastest.is_dir() and fastest != best:
            steps.insert(1, (f"{evaluate} checkpoint=fastest", "race the fastest reliable checkpoint"))
        if config["evaluation"].get("real_car"):
            steps[0] = (
                f"{evaluate} evaluation=real_car",
                "race the best checkpoint as the physical car would",
            )
            export = command_line("export", word, config, OF_POLICY)
            steps.insert(1, (f"{export} format=car", "write the archive for the car's console"))
    if summary["status"] in (INTERRUPTED, FAILED):
        return [(resume, "continue it from its last checkpoint"), *steps]
    limit, rule = summary.get("limit"), summary.get("rule")
    spent = {
        "env_steps": summary["env_steps"],
        "iterations": summary["iteration"],
        "minutes": summary["wall_clock_s"] / 60,
    }
    if limit is None:
        resume = command_line("resume", name, config, [group for group in GROUPS if group != "stopping"])
        if rule == "reliable" and not config["evaluation"].get("real_car"):
            return [(f"{resume} stopping=entropy", "train longer, until nothing improves any more"), *steps]
        if rule == "overfitting" and not met_all:
            return [(f"{clone} {SECOND_PHASE}", STABLE), *steps[:-1]]
        steps.append((f"{resume} stopping=none", "continue it until its budget is used"))
    else:
        budget = {key: most for key, most in config["budget"].items() if key in spent and most is not None}
        again = {key: (most, _twice(spent[key])) for key, most in budget.items() if spent[key] >= most}
        words = [f"budget.{key}={twice}" for key, (_, twice) in again.items()]
        what = "continue it for as long again"
        if held := _rates_that_follow(config):
            # The schedules' position when the limits were reached, not that of the somewhat later end.
            until = config["budget"].get("schedule_until", 1.0)
            words.append(schedule_until(until * min(most / float(twice) for most, twice in again.values())))
            what += f", holding {' and '.join(held)}"
        steps.append((" ".join([resume, *words]), what))
    return steps


def schedule_until(share: float) -> str:
    """Return the override that lets the schedules end at a share of the budget, rounded down to be at it by then."""
    scale = 10 ** (3 - math.floor(math.log10(share)))
    return f"budget.schedule_until={math.floor(share * scale) / scale:g}"


def _rates_that_follow(config: Mapping[str, Any]) -> list[str]:
    """Return the names of the values that follow the budget in a run of ours."""
    names = []
    schedule, algorithm = config.get("lr_schedule") or {}, config.get("algorithm") or {}
    if schedule.get("kind") != "constant" and schedule.get("by", "fraction") == "fraction":
        names.append("learning rate")
    if algorithm.get("entropy_end_factor", 1.0) != 1.0 and algorithm.get("entropy_coeff"):
        names.append("entropy bonus")
    return names


def open_report(run: Path) -> tuple[str, str]:
    """Return the command that opens the report of a run, with its purpose."""
    return f"{shlex.join([COMMAND, 'analyze', run_word(run)])} --open", "open its report"


def _twice(spent: float) -> str:
    """Return twice a number of steps, iterations or minutes; of fractions of minutes two digits."""
    twice = 2 * spent
    return f"{twice:.2g}" if isinstance(twice, float) and twice < 10 else f"{round(twice)}"


def command_line(command: str, word: str, config: Mapping[str, Any], groups: Sequence[str] = GROUPS) -> str:
    """Return a command for the run that `word` names, quoted for a shell, with the user's own classes of `groups`."""
    return shlex.join([COMMAND, command, word, *named_again(config, groups)])


def run_word(run: Path) -> str:
    """Return a run's name for the command line: `best:EXPERIMENT` if it is that, else `own_word`."""
    if _is_in_runs(run):
        with contextlib.suppress(BadInput):  # its experiment may have no best run
            if best_of(run.parent.name, _RUNS).resolve() == run.resolve():
                return f"{BEST}{run.parent.name}"
    return own_word(run)


def own_word(run: Path) -> str:
    """Return a run's permanent name for the command line: its folder.

    The folder's name may be that of another run, too, which begins in the same second, or in the hour that summer time
    repeats.
    """
    return str(_RUNS / full_name(run)) if _is_in_runs(run) else str(run)


def _is_in_runs(run: Path) -> bool:
    return run.resolve().parent.parent == _RUNS.resolve()
