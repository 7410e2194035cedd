"""The HTML page of a study, which needs nothing beside it."""

import base64
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.config.overrides import key_of
from deepracer_exp.config.own_class import OF_POLICY
from deepracer_exp.errors import BadInput, count
from deepracer_exp.files import atomic_write, read_bytes
from deepracer_exp.reports.pages.page import plot, render
from deepracer_exp.runs.next_steps import COMMAND, FURTHER, SECOND_PHASE, STABLE, command_line
from deepracer_exp.runs.next_steps import outcome as run_outcome
from deepracer_exp.runs.run_files import BEST_LAP, read_config, read_head, sees_pictures
from deepracer_exp.runs.run_result import FRESH_LAPS, SWEEP_LAPS, TRAINING_LAPS, of_conditions
from deepracer_exp.sweeps.search.objectives import (
    MEASURES,
    NONE,
    objectives_of,
    score_text,
    shown_or_dash,
)
from deepracer_exp.sweeps.trial import Trial

from .best_trial import best_line, best_run, best_shown, best_trial, complete_trials, over_seeds, reranked
from .figures import FEWEST_COMPLETE, figures, importances, narrowed
from .last_race import last_race, race_rows
from .wording import ENDINGS, duration, ending_of, ending_words, parameter, short_keys, steps

_MOST_ROWS = 300
_MOST_FAILURES = 20
_MOST_PARAMETERS = 12
_LONGEST_REASON = 140
_MOST_NAMED, _LEAST_SHARE = 3, 0.1
"""Most parameters that the summary calls important, and the least share of importance of these."""
_LONGEST_TRACEBACK = 4000
_ORDER = (TrialState.COMPLETE, TrialState.RUNNING, TrialState.PRUNED, TrialState.FAIL, TrialState.WAITING)


def write_study_page(study: optuna.Study, path: Path) -> Path:
    """Write a study's page atomically.

    Raises:
        BadInput: the study was not made by a sweep.
    """
    return atomic_write(path, study_page(study))


def study_page(study: optuna.Study) -> str:
    """Return a study's page: HTML that loads nothing."""
    objectives = objectives_of(study)
    trials = study.get_trials(deepcopy=False)
    complete = complete_trials(study)
    plots = []
    for name, figure in figures(study).items():
        meta = figure["layout"]["meta"]
        plots.append(plot(figure, name, meta["title"], narrowed(figure), meta["least_width"]))
    keys = short_keys(sorted({key for trial in trials for key in trial.params}))
    return render(
        "deepracer_exp.sweeps.report",
        "report.html.j2",
        plots,
        study=study.study_name,
        headline=study_summary(study),
        tried=tried(study),
        endings=endings(trials),
        winner=_winner(study, keys) if complete else [],
        steps=_next_steps(study) if complete else [(_resume(study), "continue the search")],
        race=last_race(study),
        submit=None if last_race(study) is None else export_step(study),
        racers=race_rows(last_race(study)),
        picture=_picture(study) if complete else None,
        best=best_trial(study).number if complete else None,
        winners=_winners(study, objectives, keys),
        seeds=over_seeds(study, keys),
        objective=_words(objectives[:1], trials),
        objectives=_words(objectives, trials).capitalize(),
        too_few=FEWEST_COMPLETE if len(complete) < FEWEST_COMPLETE else None,
        trials=_table(study, objectives, keys),
        laps={"training": TRAINING_LAPS, "sweep": SWEEP_LAPS, "fresh": FRESH_LAPS},
        failures=_failures(trials),
        space=study.user_attrs.get("space") or {},
        base=study.user_attrs.get("base") or [],
        facts=_facts(study, objectives),
    )


def study_summary(study: optuna.Study) -> list[str]:
    """Return the results of a study in a few sentences, the most important first."""
    trials = study.get_trials(deepcopy=False)
    ended = [trial for trial in trials if trial.state.is_finished()]
    complete = [trial for trial in ended if trial.state == TrialState.COMPLETE]
    total = study.user_attrs.get("trials", len(trials))
    sentences: list[str] = []
    if (race := last_race(study)) is not None:
        sentences += filter(None, (race.verdict(), race.doubt()))
    if complete:
        best = best_trial(study)
        sentences.append(f"Trial {best.number} is the best: {best_shown(study)}.")
        if Trial.of(best).lap_time_s is None:
            sentences.append("It completed no lap.")
        if len(study.directions) > 1:
            sentences.append(f"{len(study.best_trials)} trials are on the Pareto front.")
    else:
        sentences.append("No trial is complete, so there is no best one.")
    spent, wasted = _spent(ended), _spent([t for t in ended if t.state != TrialState.COMPLETE])
    share = f", {100 * wasted / spent:.0f}% of them in trials that were pruned or failed" if spent else ""
    return [
        *sentences,
        f"{len(ended)} of {count(total, 'trial')} ended, {len(complete)} of them complete; they drove {steps(spent)} "
        f"control steps{share}.",
    ]


def tried(study: optuna.Study) -> str:
    """Name the searched parameters, and the most important ones."""
    keys = short_keys(sorted({key for trial in study.get_trials(deepcopy=False) for key in trial.params}))
    if not keys:
        return ""
    words = f"Tried: {', '.join(keys.values())}."
    mattered = [(key, share) for key, share in importances(study).items() if share >= _LEAST_SHARE]
    shown_shares = ", ".join(f"{keys[key]} ({share:.0%})" for key, share in mattered[:_MOST_NAMED])
    return f"{words} What mattered most: {shown_shares}." if mattered else words


def _winner(study: optuna.Study, keys: dict[str, str]) -> list[tuple[str, str]]:
    """Return the winner's parameters and results, as names and values."""
    best = best_trial(study)
    results = Trial.of(best)
    lines = [
        *((keys[key], parameter(value)) for key, value in best.params.items()),
        ("Mean usual lap", shown_or_dash("lap_time", results.lap_time_s)),
        ("Usual completion", shown_or_dash("completion", results.completion)),
        ("How its training ended", results.reason or ending_words(ending_of(best))),
    ]
    try:
        run = read_head(best_run(study))
    except BadInput:  # moved or removed since
        return lines
    shown = {name.lower() for name, _ in lines}
    return [
        pair for pair in run_outcome(run) if pair[0] in ("Track", "Reward") and pair[0].lower() not in shown
    ] + lines


def _next_steps(study: optuna.Study) -> list[tuple[str, str]]:
    """Return commands for the winner, each with its purpose."""
    winner = f"best:{study.study_name}"
    try:
        config = read_config(best_run(study))
    except BadInput:  # moved or removed since
        config = {}
    evaluate = command_line("evaluate", winner, config, OF_POLICY)
    clone = command_line("clone", winner, config)
    where = "".join(f" {shlex.quote(word)}" for word in _where(study))
    more = 2 * int(study.user_attrs.get("trials", len(study.trials)))
    race_it = (f"{evaluate}{where} --video lap.mp4", "race it, and film its fastest usual lap")
    further = (f"{_resume(study)} sweep.trials={more}", "continue the search, with twice the trials")
    if last_race(study) is None:
        again = (best_line(study), "train the winner again")
        return [again, race_it, (f"{clone}{where} {SECOND_PHASE}", STABLE), further]
    again = (best_line(study), f"train trial {best_trial(study).number} again")
    return [export_step(study), race_it, (f"{clone}{where}", FURTHER), again, further]


def export_step(study: optuna.Study) -> tuple[str, str]:
    """Return the command that exports the run to submit, with its output in words.

    Only this simulator knows features of the road: for a policy that reads them, the export has files to train with on
    the service, without weights.
    """
    race = last_race(study)
    assert race is not None
    try:
        config = read_config(best_run(study).with_name(race.racers[0].run))
    except BadInput:  # moved or removed since
        config = {}
    line = command_line("export", f"best:{study.study_name}", config, OF_POLICY)
    wanted, what = "aws", "its reward function, actions and hyperparameters, for the console"
    if sees_pictures(config):
        wanted, what = "aws-model", "its model, for the console"
    where = "".join(f" {shlex.quote(word)}" for word in _where(study))
    return f"{line} format={wanted}{where}", f"write {what}"


def _resume(study: optuna.Study) -> str:
    return shlex.join([COMMAND, "sweep", f"study={study.study_name}", *_where(study)])


def _where(study: optuna.Study) -> list[str]:
    """Return the override with the place of the study's runs, if one was given."""
    return [word for word in study.user_attrs.get("base") or () if key_of(word) == "runs_dir"]


def _picture(study: optuna.Study) -> str | None:
    """Return the picture of the fastest exploring lap of the winner's training in base64, None where there is none."""
    try:
        picture = read_bytes(best_run(study) / BEST_LAP, "the picture that a training draws")
    except BadInput:
        return None
    return base64.b64encode(picture).decode("ascii")


def endings(trials: Sequence[FrozenTrial]) -> list[dict[str, Any]]:
    """Return for each ending its trials and control steps, with their shares in per cent."""
    spent, counted = _spent(trials), []
    for ending, style in ENDINGS.items():
        if some := [trial for trial in trials if ending_of(trial) == ending]:
            counted.append(
                {
                    "ending": ending_words(ending),
                    "color": style.color,
                    "meaning": style.meaning,
                    "count": len(some),
                    "trials_share": 100 * len(some) / len(trials),
                    "steps": steps(_spent(some)),
                    "steps_share": 100 * _spent(some) / spent if spent else 0.0,
                }
            )
    return counted


def _spent(trials: Sequence[FrozenTrial]) -> int:
    return sum(Trial.of(trial).env_steps for trial in trials)


def _has_held_out(trials: Sequence[FrozenTrial]) -> bool:
    return any(Trial.of(trial).held_out_completion is not None for trial in trials)


def _words(objectives: Sequence[str], trials: Sequence[FrozenTrial]) -> str:
    """Return the names of the objectives."""
    return ", ".join(of_conditions(MEASURES[name].words, _has_held_out(trials)) for name in objectives)


def _winners(study: optuna.Study, objectives: Sequence[str], keys: dict[str, str]) -> list[dict[str, Any]]:
    """Return the re-ranked trials, the best on fresh laps first."""
    by_number = {trial.number: trial for trial in complete_trials(study)}
    tables = []
    for laps in reranked(study):
        trial = by_number[laps.trial]
        params = ", ".join(f"{keys[key]} {parameter(value)}" for key, value in trial.params.items())
        tables.append(
            {
                "trial": trial.number,
                "now": ", ".join(map(score_text, objectives, laps.values)),
                "before": ", ".join(map(score_text, objectives, trial.values)),
                "interval": " to ".join(score_text(objectives[0], end) for end in laps.interval),
                "lap_time": shown_or_dash("lap_time", laps.lap_time_s),
                "completion": shown_or_dash("completion", laps.completion),
                "held_out": shown_or_dash("completion", laps.held_out_completion),
                "parameters": params,
            }
        )
    return tables


def _table(study: optuna.Study, objectives: Sequence[str], keys: dict[str, str]) -> dict[str, Any]:
    """Return the table of trials: complete ones, the best first, then running, pruned and failed ones."""
    trials = study.get_trials(deepcopy=False)
    rank = {trial.number: place for place, trial in enumerate(complete_trials(study))}
    order = sorted(trials, key=lambda t: (_ORDER.index(t.state), rank.get(t.number, t.number)))
    columns = list(keys)[:_MOST_PARAMETERS]
    extra = [
        (attr, objective)
        for attr, objective in (("lap_time_s", "lap_time"), ("completion", "completion"))
        if objective not in objectives
    ]
    rows = []
    for trial in order[:_MOST_ROWS]:
        results, ending = Trial.of(trial), ending_of(trial)
        values = [shown_or_dash(name, _value(trial, index)) for index, name in enumerate(objectives)]
        values += [shown_or_dash(objective, getattr(results, attr)) for attr, objective in extra]
        values.append(shown_or_dash("completion", results.held_out_completion))
        reason = results.reason
        rows.append(
            {
                "number": trial.number,
                "ending": ending_words(ending),
                "color": ENDINGS[ending].color,
                "complete": trial.state == TrialState.COMPLETE,
                "values": values,
                "steps": steps(results.env_steps) if results.env_steps else NONE,
                "time": duration(results.wall_clock_s) if trial.state.is_finished() else NONE,
                "parameters": [parameter(trial.params.get(key, NONE)) for key in columns],
                "reason": reason if len(reason) <= _LONGEST_REASON else f"{reason[: _LONGEST_REASON - 1]}…",
            }
        )
    names = (*objectives, *dict(extra).values())
    titles = [of_conditions(MEASURES[name].title, _has_held_out(trials)) for name in names]
    return {
        "rows": rows,
        "left_out": max(0, len(order) - _MOST_ROWS),
        "measures": [*titles, "Held-out completion"],
        "parameters": [(keys[key], key) for key in columns],
        "more_parameters": len(keys) - len(columns),
    }


def _value(trial: FrozenTrial, index: int) -> float | None:
    """Return a trial's value of one objective, of a pruned one the last it had; None if it has none."""
    if trial.state == TrialState.COMPLETE:
        return trial.values[index]
    if trial.state == TrialState.PRUNED and trial.last_step is not None:
        return trial.intermediate_values[trial.last_step]
    return None


def _failures(trials: Sequence[FrozenTrial]) -> list[dict[str, Any]]:
    """Return failed trials by their reason, with the traceback of the first of each, the most frequent first."""
    groups: dict[str, list[FrozenTrial]] = {}
    for trial in trials:
        if trial.state == TrialState.FAIL:
            groups.setdefault(Trial.of(trial).reason or "no reason stored", []).append(trial)
    failures: list[dict[str, Any]] = [
        {
            "reason": reason,
            "numbers": ", ".join(str(trial.number) for trial in some[:12]) + ", …" * (len(some) > 12),
            "count": len(some),
            "traceback": Trial.of(some[0]).traceback[-_LONGEST_TRACEBACK:],
        }
        for reason, some in groups.items()
    ]
    return sorted(failures, key=lambda failure: failure["count"], reverse=True)[:_MOST_FAILURES]


def _facts(study: optuna.Study, objectives: Sequence[str]) -> list[tuple[str, str]]:
    attrs = study.user_attrs
    facts = [
        ("Objective" + "s" * (len(objectives) > 1), _words(objectives, study.get_trials(deepcopy=False))),
        ("Evaluation", str(attrs.get("protocol", NONE))),
        ("Seeds of a trial", str(attrs.get("seeds", 1))),
        ("Runs", f"{attrs.get('runs_dir', 'runs')}/{study.study_name}"),
    ]
    run_id = attrs.get("mlflow_run_id")
    return [*facts, ("MLflow run", str(run_id))] if run_id else facts
