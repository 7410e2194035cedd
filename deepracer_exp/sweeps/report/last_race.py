"""The last race of a study: the clone of the best trial and the best two trials compete to be submitted."""

from dataclasses import dataclass
from pathlib import Path

import optuna

from deepracer_exp.config.sweep import SweepConfig
from deepracer_exp.errors import count
from deepracer_exp.runs.best_run import BestOfSweep, write_best_of_sweep
from deepracer_exp.runs.run_result import BOTH, of_conditions
from deepracer_exp.sweeps.search.objectives import score_text, shown_or_dash

from .best_trial import complete_trials

LAST_RACE = "last_race"
"""Attribute of a study in Optuna: the results of the policies, and the number of complete trials at that time."""


@dataclass(frozen=True, kw_only=True)
class Racer:
    """A policy of the last race with its results."""

    trial: int
    """Number of its trial; for the clone, of its parent."""
    is_clone: bool
    run: str
    """Name of its run's folder, beside the other runs of the study."""
    checkpoint: str
    race_score_s: float
    """Over all conditions; without a complete lap as `objective_values` has it."""
    interval: list[float]
    """Both ends of the 95 per cent interval of the race score."""
    lap_time_s: float | None
    """Mean usual lap."""
    laps_percent: float
    """Complete laps of a hundred tried on the usual conditions."""
    completion: float
    """Usual completion, per cent of the lap."""
    held_out_laps_percent: float | None = None
    held_out_completion: float | None = None

    @property
    def name(self) -> str:
        """Return the policy's name: ``trial 7``, ``the clone of trial 7``."""
        return f"the clone of trial {self.trial}" if self.is_clone else f"trial {self.trial}"


@dataclass(frozen=True, kw_only=True)
class LastRace:
    """The result of the last race; the first of its racers is the one to submit."""

    laps: int
    """Laps that each of them drove on each track and condition."""
    cloned_with: str
    """The overrides of the clone, as `clone_words` has them."""
    racers: tuple[Racer, ...]
    """The policies, the lowest race score first."""

    def __post_init__(self) -> None:
        """Sort the racers."""
        object.__setattr__(self, "racers", tuple(sorted(self.racers, key=lambda racer: racer.race_score_s)))

    @property
    def has_held_out(self) -> bool:
        """Whether there were laps on held-out conditions."""
        return self.racers[0].held_out_completion is not None

    @property
    def measure(self) -> str:
        """Return the name of the race score under the conditions of the laps."""
        return of_conditions(BOTH, self.has_held_out)

    def rule(self) -> str:
        """Return the rule that chooses the policy to submit."""
        conditions = " of both conditions together" if self.has_held_out else ""
        return (
            f"the lowest {self.measure}, the seconds per complete lap{conditions}, failed laps included, on "
            f"{count(self.laps, 'lap')} a condition, the same for all and none of those that chose the trials"
        )

    def verdict(self) -> str:
        """Return a sentence with the policy to submit and the reason."""
        first, *others = self.racers
        score = score_text("race_score", first.race_score_s)
        against = " and ".join(
            f"{score_text('race_score', other.race_score_s)} of {other.name}" for other in others
        )
        return f"Submit {first.name}: its {self.measure} on fresh laps is {score}, against {against}."

    def doubt(self) -> str:
        """Name the policies whose results differ from the first by no more than chance; empty without any."""
        first, *others = self.racers
        alike = [other.name for other in others if other.interval[0] <= first.interval[1]]
        if not alike:
            return ""
        theirs = "that" if len(alike) == 1 else "those"
        return f"Its interval overlaps {theirs} of {' and '.join(alike)}: chance may decide between them."


def clone_words(config: SweepConfig) -> str:
    """Return the overrides of a study's clone as people write them."""
    words = " ".join(f"{key}={value}" for key, value in (config.clone or {}).items())
    return words or "the settings of its trial"


def last_race(study: optuna.Study) -> LastRace | None:
    """Return the last race of a study; None before it, and again once more trials are complete."""
    stored = study.user_attrs.get(LAST_RACE)
    if not stored or stored["of"] != len(complete_trials(study)):
        return None
    racers = tuple(Racer(**racer) for racer in stored["racers"])
    return LastRace(laps=stored["laps"], cloned_with=stored["cloned_with"], racers=racers)


def store_last_race(study: optuna.Study, race: LastRace) -> None:
    """Store the last race with the study."""
    racers = [vars(racer) for racer in race.racers]
    content = {"of": len(complete_trials(study)), "laps": race.laps, "cloned_with": race.cloned_with}
    study.set_user_attr(LAST_RACE, {**content, "racers": racers})


def write_submitted(study: optuna.Study, runs_dir: Path, race: LastRace) -> Path:
    """Write best_of_sweep.json beside the study's runs, so that `best:STUDY` is the run to submit."""
    first = race.racers[0]
    values = {"race_score": first.race_score_s}
    return write_best_of_sweep(
        runs_dir / study.study_name,
        BestOfSweep(study=study.study_name, trial=first.trial, run_dir=first.run, values=values),
    )


def race_rows(race: LastRace | None) -> list[dict[str, str]]:
    """Return the last race as texts, a row for each policy; none where there was no race."""
    return [
        {
            "name": f"{racer.name[0].upper()}{racer.name[1:]}",
            "checkpoint": racer.checkpoint,
            "score": score_text("race_score", racer.race_score_s),
            "interval": " to ".join(score_text("race_score", end) for end in racer.interval),
            "lap_time": shown_or_dash("lap_time", racer.lap_time_s),
            "laps": score_text("completion", racer.laps_percent),
            "held_out_laps": shown_or_dash("completion", racer.held_out_laps_percent),
            "held_out": shown_or_dash("completion", racer.held_out_completion),
        }
        for racer in (race.racers if race else ())
    ]
