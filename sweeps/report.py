"""One HTML page that tells all of a study, and needs nothing beside it."""

import base64
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.analysis.next_steps import COMMAND, outcome
from deepracer_exp.analysis.page import plot, render
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.run_files import read_head
from deepracer_exp.formats.user_file import read_bytes
from deepracer_exp.formats.whole_file import write_whole

from .best import best_line, best_run, best_trial, best_values, complete_trials, reranked
from .fates import FATES, fate_of, words
from .figures import FEWEST_COMPLETE, figures, least_width, narrowed, value_of
from .labels import (
    MEASURES,
    NONE,
    described,
    duration,
    objectives_of,
    parameter,
    short_keys,
    shown,
    shown_values,
    steps,
)

_MOST_ROWS = 300
_MOST_FAILURES = 20
_MOST_PARAMETERS = 12
_LONGEST_REASON = 140
_LONGEST_TRACEBACK = 4000
_ORDER = (TrialState.COMPLETE, TrialState.RUNNING, TrialState.PRUNED, TrialState.FAIL, TrialState.WAITING)
_NOTES = {
    "history": "Complete trials are filled shapes, pruned ones crosses at what they had when they were pruned. "
    "The line is the best complete trial until then. What is far worse than the better half, as a trial without "
    "a complete lap, stands at the edge, and a line says how far it is beyond.",
    "pareto": "Complete trials only.",
    "importance": "PED-ANOVA over the complete trials: how much the values of the best quarter differ from those of "
    "all. The lines and the numbers in brackets hold 90 % of what comes out when the trials are drawn again from these "
    "(bootstrap): where two of them overlap, it is not known which mattered more. A parameter of some trials only is "
    "measured among those.",
    "slice": "A slope or a cloud at one end says where to search next.",
    "parallel": "Drag along an axis to see only the trials in that part, drag a name to move its axis. A dash is a "
    "trial without this parameter.",
    "entropy": "Policies begin near the top (all actions alike) and come down as they settle. Click a word of the "
    "legend to hide its trials, twice to see them alone.",
}


def write_report(study: optuna.Study, path: Path) -> Path:
    """Write a study's page, whole or not at all.

    Raises:
        BadInput: the study was not made by a sweep.
    """
    return write_whole(path, report(study))


def report(study: optuna.Study) -> str:
    """Return a study's page: HTML that loads nothing.

    Raises:
        BadInput: the study was not made by a sweep.
    """
    objectives = objectives_of(study)
    trials = study.get_trials(deepcopy=False)
    plots = [
        plot(figure, name, figure.layout.meta["title"], narrowed(figure), least_width(figure))
        for name, figure in figures(study).items()
    ]
    won = any(trial.state == TrialState.COMPLETE for trial in trials)
    keys = short_keys(sorted({key for trial in trials for key in trial.params}))
    return render(
        "sweeps",
        "report.html.j2",
        plots,
        study=study.study_name,
        headline=headline(study),
        fates=fates(trials),
        outcome=_outcome(study, objectives, keys) if won else [],
        steps=_next_steps(study) if won else [(_resume(study), "search on")],
        picture=_picture(study) if won else None,
        best=best_trial(study).number if won else None,
        winners=_winners(study, objectives, keys),
        notes=_NOTES,
        too_few=None
        if sum(t.state == TrialState.COMPLETE for t in trials) >= FEWEST_COMPLETE
        else FEWEST_COMPLETE,
        trials=_table(study, objectives, keys),
        failures=_failures(trials),
        space=study.user_attrs.get("space") or {},
        base=study.user_attrs.get("base") or [],
        facts=_facts(study, objectives),
    )


def headline(study: optuna.Study) -> list[str]:
    """Return what came of a study in a few sentences, the most important first."""
    objectives, trials = objectives_of(study), study.get_trials(deepcopy=False)
    ended = [trial for trial in trials if trial.state.is_finished()]
    complete = [trial for trial in ended if trial.state == TrialState.COMPLETE]
    total = study.user_attrs.get("trials", len(trials))
    sentences = []
    if complete:
        best = best_trial(study)
        again = next((one for one in reranked(study) if one["trial"] == best.number), None)
        fresh = " on fresh laps" if again else ""
        sentences.append(
            f"Trial {best.number} is the best: {shown_values(objectives, best_values(study))}{fresh}."
        )
        if best.user_attrs.get("lap_time_s") is None:
            sentences.append("It completed no lap.")
        if len(objectives) > 1:
            sentences.append(f"{len(study.best_trials)} trials are on the Pareto front.")
    else:
        sentences.append("No trial is complete, so there is no best one.")
    spent, wasted = (_spent(some) for some in (ended, [t for t in ended if t.state != TrialState.COMPLETE]))
    share = f", {100 * wasted / spent:.0f} % of them in trials that were pruned or failed" if spent else ""
    sentences.append(
        f"{len(ended)} of {total} trials ended, {len(complete)} of them complete; they drove {steps(spent)} control "
        f"steps{share}."
    )
    return sentences


def _outcome(study: optuna.Study, objectives: Sequence[str], keys: dict[str, str]) -> list[tuple[str, str]]:
    """Return what the winner is and what came of it, in names and values."""
    best = best_trial(study)
    found = [(f"{keys[key]}", parameter(value)) for key, value in best.params.items()]
    found.append(("Lap time in evaluation", described("lap_time", best.user_attrs.get("lap_time_s"))))
    found.append(("Completion in evaluation", described("completion", best.user_attrs.get("completion"))))
    found.append(("How its training ended", str(best.user_attrs.get("reason") or words(fate_of(best)))))
    try:
        run = read_head(best_run(study))
    except BadInput:  # moved or removed since
        return found
    return [pair for pair in outcome(run) if pair[0] in ("Track", "Reward")] + found


def _next_steps(study: optuna.Study) -> list[tuple[str, str]]:
    """Return what to do with the winner: commands, each with what it does."""
    winner = shlex.quote(f"run=best:{study.study_name}")
    more = 2 * int(study.user_attrs.get("trials", len(study.trials)))
    return [
        (best_line(study), "train the winner again"),
        (f"{COMMAND} evaluate {winner} --video lap.mp4", "race it, and film its fastest lap"),
        (f"{COMMAND} clone {winner}", "train on from it, at a tenth of the learning rate"),
        (f"{_resume(study)} sweep.trials={more}", "search on, with twice the trials"),
    ]


def _resume(study: optuna.Study) -> str:
    return shlex.join([COMMAND, "sweep", f"study={study.study_name}"])


def _picture(study: optuna.Study) -> str | None:
    """Return the picture of the winner's fastest lap in base64, None where there is none."""
    try:
        picture = read_bytes(best_run(study) / "best_lap.png", "the picture that a training draws")
    except BadInput:
        return None
    return base64.b64encode(picture).decode("ascii")


def fates(trials: Sequence[FrozenTrial]) -> list[dict[str, Any]]:
    """Return how many trials ended in which way, and the control steps they drove."""
    total, spent = len(trials), _spent(trials)
    found = []
    for fate, look in FATES.items():
        some = [trial for trial in trials if fate_of(trial) == fate]
        if some:
            told = {"fate": words(fate), "color": look.color, "meaning": look.meaning, "count": len(some)}
            told |= {"trials_share": 100 * len(some) / total, "steps": steps(_spent(some))}
            found.append(told | {"steps_share": 100 * _spent(some) / spent if spent else 0.0})
    return found


def _spent(trials: Sequence[FrozenTrial]) -> int:
    return sum(trial.user_attrs.get("env_steps") or 0 for trial in trials)


def _winners(study: optuna.Study, objectives: Sequence[str], keys: dict[str, str]) -> list[dict[str, Any]]:
    """Return the trials that drove again on fresh laps, the best first."""
    by_number = {trial.number: trial for trial in complete_trials(study)}
    found = []
    for one in reranked(study):
        trial = by_number.get(one["trial"])
        interval = one.get("interval")
        told: dict[str, Any] = {"trial": one["trial"], "now": shown_values(objectives, one["values"])}
        told["before"] = shown_values(objectives, trial.values) if trial else NONE
        told["interval"] = " to ".join(shown(objectives[0], end) for end in interval) if interval else NONE
        told["lap_time"] = described("lap_time", one.get("lap_time_s"))
        told["completion"] = described("completion", one.get("completion"))
        told["held_out"] = described("completion", one.get("held_out_completion"))
        parameters = trial.params.items() if trial else ()
        told["parameters"] = ", ".join(f"{keys[key]} {parameter(value)}" for key, value in parameters)
        found.append(told)
    return found


def _table(study: optuna.Study, objectives: Sequence[str], keys: dict[str, str]) -> dict[str, Any]:
    """Return the table of trials: the complete ones from the best on, then those that go on, were pruned, failed."""
    trials = study.get_trials(deepcopy=False)
    place = {trial.number: number for number, trial in enumerate(complete_trials(study))}
    order = sorted(trials, key=lambda t: (_ORDER.index(t.state), place.get(t.number, t.number)))
    columns = [key for key in keys if any(key in trial.params for trial in trials)][:_MOST_PARAMETERS]
    extra = [
        (attr, objective)
        for attr, objective in (("lap_time_s", "lap_time"), ("completion", "completion"))
        if objective not in objectives
    ]
    rows = []
    for trial in order[:_MOST_ROWS]:
        attrs = trial.user_attrs
        values = [described(name, value_of(trial, objectives, at)) for at, name in enumerate(objectives)]
        values += [described(objective, attrs.get(attr)) for attr, objective in extra]
        values.append(described("completion", attrs.get("held_out_completion")))
        fate = fate_of(trial)
        reason = str(attrs.get("reason") or "")
        clock_s = attrs.get("wall_clock_s")
        rows.append(
            {
                "number": trial.number,
                "fate": words(fate),
                "color": FATES[fate].color,
                "complete": trial.state == TrialState.COMPLETE,
                "values": values,
                "steps": steps(attrs["env_steps"]) if attrs.get("env_steps") else NONE,
                "time": NONE if clock_s is None else duration(clock_s),
                "parameters": [parameter(trial.params[k]) if k in trial.params else NONE for k in columns],
                "reason": reason if len(reason) <= _LONGEST_REASON else f"{reason[: _LONGEST_REASON - 1]}…",
            }
        )
    heads = [MEASURES[name].title for name in (*objectives, *(objective for _, objective in extra))]
    return {
        "rows": rows,
        "left_out": max(0, len(order) - _MOST_ROWS),
        "measures": [*heads, "Held-out"],
        "parameters": [(keys[key], key) for key in columns],
        "more_parameters": len(keys) - len(columns),
    }


def _failures(trials: Sequence[FrozenTrial]) -> list[dict[str, Any]]:
    """Return failed trials by their reason, with the traceback of the first of each, the most frequent first."""
    groups: dict[str, list[FrozenTrial]] = {}
    for trial in trials:
        if trial.state == TrialState.FAIL:
            groups.setdefault(str(trial.user_attrs.get("reason") or "no reason told"), []).append(trial)
    found: list[dict[str, Any]] = [
        {
            "reason": reason,
            "numbers": ", ".join(str(trial.number) for trial in some[:12]) + ", …" * (len(some) > 12),
            "count": len(some),
            "traceback": str(some[0].user_attrs.get("traceback") or "")[-_LONGEST_TRACEBACK:],
        }
        for reason, some in groups.items()
    ]
    return sorted(found, key=lambda one: one["count"], reverse=True)[:_MOST_FAILURES]


def _facts(study: optuna.Study, objectives: Sequence[str]) -> list[tuple[str, str]]:
    attrs = study.user_attrs
    facts: list[tuple[str, str]] = [
        ("Objective" + "s" * (len(objectives) > 1), ", ".join(MEASURES[name].words for name in objectives)),
        ("Evaluation", str(attrs.get("protocol", NONE))),
        ("Seeds of a trial", str(attrs.get("seeds", 1))),
        ("Runs", f"{attrs.get('runs_dir', 'runs')}/{study.study_name}"),
    ]
    if run_id := attrs.get("mlflow_run_id"):
        facts.append(("MLflow run", str(run_id)))
    return facts
