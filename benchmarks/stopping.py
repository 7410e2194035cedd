"""What stopping in time saves, and what it costs.

    python -m benchmarks.stopping [--seeds 5] [--first-seed 0] [--tracks A,B,C] [--jobs 2] [--steps 3000000]
                                  [--trials 64] [--reuse DIR] [--json FILE] [OVERRIDE...]

For each track and seed, `deepracer-exp train` runs the default experiment for the full budget, without a stopping
rule. Since a seed gives the same run every time, the run that `stopping=entropy` ends is the
beginning of that one: the rule is applied to its metrics.jsonl. One run, the first seed on the first track, is really
run with the rule; it must end after the same iteration with the same metrics and best, or this benchmark fails.

The kept checkpoint is the best one of the beginning by the evaluations every few iterations, the other the best of the
whole run. (When a run ends, its last policy is evaluated, too; the beginning lacks that evaluation.) Then both drive
again: 64 laps on usual and 64 on held-out conditions, with starts and draws that no evaluation of the training had, so
that the figures are not those by which they were chosen.

- `steps_saved`: share of all runs' control steps that need not have been driven;
- `lap_time_loss`: how much slower the kept checkpoint's mean lap is, as a share; mean over the runs where both
  checkpoints complete laps (`without_lap` counts the others);
- `completion_kept`, `completion_full`: per cent of the lap, mean over runs; likewise on held-out conditions;
  `completion_change` is their difference, with its interval over runs.

The tracks differ in length and shape: the default one (17.7 m, 0.76 m wide), the narrowest (Oval_track, 19.6 m, 0.67 m
wide) and a real circuit more than three times as long, driven clockwise (Spain_track, 60.0 m).

The thresholds of the rule were chosen by looking at the seeds 0 to 4 of these tracks; `--first-seed 5` takes seeds that
no one has looked at.

`--reuse DIR` leaves the runs in DIR and takes those that it finds finished there: an interrupted benchmark continues,
and a changed rule costs no new training.
"""

import argparse
import json
import statistics
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.stopping import StoppingConfig
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.evaluation.results import NOT_EVALUATED
from deepracer_exp.runs.checkpoints import checkpoint_name, read_training
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.training.stopping.stopping_rules import Decision, build_rule

from .command import at_once, read_metrics, read_summary, trained
from .fresh import TRIALS, Driven, drive
from .report import benchmark_parser, mean_and_interval, number, percent, table, write_json
from .same import different_rows

TRACKS = ("reinvent_base", "Oval_track", "Spain_track")
RULE = "stopping=entropy"
WANTED = {"steps_saved": 0.5, "lap_time_loss": 0.02}
"""At least, and at most; the completion no lower."""
_MEANS = ("completion", "held_out_completion", "lap_share")


def training_overrides(track: str, seed: int, steps: int, overrides: Sequence[str], rule: str) -> list[str]:
    """Return the overrides of `deepracer-exp train`."""
    # Every checkpoint stays: the best of the beginning is not the best of the whole run.
    keep = ("checkpoints.keep=1000", "tracking=off", f"budget.env_steps={steps}")
    return [f"track={track}", *overrides, rule, *keep, f"seed={seed}"]


def best_within(run: Path, iteration: int) -> str:
    """Return the name of the checkpoint that a run ended after `iteration` would have kept as its best.

    Raises:
        SystemExit: none had been evaluated by then.
    """
    folders = sorted(path for path in run.glob("checkpoints/[0-9]*") if int(path.name) <= iteration)
    # Each stores the best until then, for a resumed training.
    best = read_training(folders[-1])["best"] if folders else None
    if best is None:
        raise SystemExit(f"{run}: no policy was evaluated within {iteration} iterations")
    return checkpoint_name(best["iteration"])


def prove(full: Path, stopped: Path, iteration: int, kept: str) -> dict[str, Any]:
    """Compare a run that its rule has really ended with the beginning of the full one.

    Args:
        full: the run without a rule.
        stopped: the one with it.
        iteration: after which the rule ends the full run.
        kept: its best checkpoint until then.

    Raises:
        SystemExit: they differ.
    """
    summary, rows = read_summary(stopped), read_metrics(stopped)
    # The last policy of a run that ends is evaluated; in the full run it was not.
    *before, last = read_metrics(full)[:iteration]
    found = different_rows([*before, last | {key: rows[-1][key] for key in NOT_EVALUATED}], rows)
    ended = (summary["iteration"], checkpoint_name(summary["best"]["iteration"]))
    if found is not None or ended not in ((iteration, kept), (iteration, checkpoint_name(iteration))):
        raise SystemExit(
            f"{stopped}: ended after {ended[0]} iterations and kept {ended[1]}; the rule ends {full} after {iteration} "
            f"and keeps {kept}; {found or 'their metrics are the same'}"
        )
    return {"run": stopped.name, "iteration": iteration, "kept": int(kept), "same_metrics": True}


def replay(run: Path, rule: StoppingConfig) -> tuple[Decision | None, list[dict[str, Any]]]:
    """Return the decision by which a rule would have ended a run, and the rows of its metrics until then."""
    rows = read_metrics(run)
    stopping = build_rule(rule, build_action_space(StoredRun(run).experiment.action_space).n)
    for place, row in enumerate(rows):
        if (decision := stopping.observe(row)) is not None:
            return decision, rows[: place + 1]
    return None, rows


def measure(run: Path, rule: StoppingConfig, trials: int = TRIALS) -> dict[str, Any]:
    """Apply the rule to a full run and let both checkpoints drive."""
    decision, until = replay(run, rule)
    end, last = until[-1], read_metrics(run)[-1]
    # A run that ends is raced once more: the best of the full run may be its last policy.
    best = (run / "checkpoints" / "best").resolve().name
    kept = best if end["iteration"] == last["iteration"] else best_within(run, end["iteration"])
    names = dict.fromkeys((kept, best))
    driven = dict(zip(names, drive(run, list(names), trials), strict=True))
    return {
        "run": run.name,
        "rule": None if decision is None else decision.rule,
        "iteration": end["iteration"],
        "iterations": last["iteration"],
        "env_steps": end["env_steps"],
        "saved_steps": last["env_steps"] - end["env_steps"],
        "saved": round(1 - end["env_steps"] / last["env_steps"], 4),
        "kept": int(kept),
        "full": int(best),
        "lap_time_loss": lap_time_loss(driven[kept], driven[best]),
        **driven[kept].named("kept"),
        **driven[best].named("full"),
    }


def lap_time_loss(kept: Driven, full: Driven) -> float | None:
    """Return how much slower the kept policy's mean lap is, as a share; None if one completes no lap."""
    if kept.lap_time_s is None or full.lap_time_s is None:
        return None
    return round(kept.lap_time_s / full.lap_time_s - 1, 5)


def summarize(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures over runs."""
    losses = [run["lap_time_loss"] for run in runs]
    loss = mean_and_interval(losses)
    change = mean_and_interval([run["completion_kept"] - run["completion_full"] for run in runs])
    total = sum(run["env_steps"] + run["saved_steps"] for run in runs)
    return {
        "steps_saved": round(sum(run["saved_steps"] for run in runs) / total, 4),
        "lap_time_loss": loss["mean"],
        "lap_time_loss_interval": loss["interval"],
        "without_lap": losses.count(None),
        "completion_change": change["mean"],
        "completion_change_interval": change["interval"],
        **{
            f"{key}_{which}": round(statistics.fmean(run[f"{key}_{which}"] for run in runs), 4)
            for key in _MEANS
            for which in ("kept", "full")
        },
    }


def markdown(runs: Sequence[dict[str, Any]]) -> str:
    """Return the table of runs, with the figures of each track and of all."""
    head = ("track, seed", "rule", "ends after", "saved", "lap (s)", "of full run", "loss")
    completion = ("done (%)", "of full run", "held-out", "of full run")
    rows = [
        (
            f"`{run['track']}`, {run['seed']}",
            run["rule"] or "-",
            f"{run['iteration']} of {run['iterations']}",
            percent(run["saved"]),
            *(number(run[f"lap_time_s_{which}"], 2) for which in ("kept", "full")),
            percent(run["lap_time_loss"], 1),
            *(number(run[f"{key}_{which}"], 1) for key in _MEANS[:2] for which in ("kept", "full")),
        )
        for run in runs
    ]

    def means(name: str, of: Sequence[dict[str, Any]]) -> tuple[str, ...]:
        figures = summarize(of)
        done = (number(figures[f"{key}_{which}"], 1) for key in _MEANS[:2] for which in ("kept", "full"))
        loss, saved = percent(figures["lap_time_loss"], 1), percent(figures["steps_saved"])
        return (name, "", "", saved, "", "", loss, *done)

    tracks = dict.fromkeys(run["track"] for run in runs)
    rows += [means(f"`{track}`", [run for run in runs if run["track"] == track]) for track in tracks]
    return table((*head, *completion), [*rows, means("all", runs)])


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("stopping", __doc__)
    parser.add_argument("--seeds", type=int, default=5, help="runs on each track")
    parser.add_argument("--first-seed", type=int, default=0, help="the others follow it")
    parser.add_argument("--tracks", default=",".join(TRACKS), help="options of the group track")
    parser.add_argument("--jobs", type=int, default=2, help="trainings at once")
    parser.add_argument("--steps", type=int, default=3_000_000, help="control steps of the full budget")
    parser.add_argument("--trials", type=int, default=TRIALS, help="laps that each checkpoint drives again")
    parser.add_argument(
        "--reuse", type=Path, metavar="DIR", help="keep runs here, and take the finished ones"
    )
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        result = benchmark(options, (options.reuse or Path(temporary)).resolve())
    print(f"\n{markdown(result['runs'])}\n\nwanted: {WANTED}, completion no lower")
    write_json(options.json, result)
    print(json.dumps(result))


def benchmark(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Train what is not in `folder` yet, and measure."""
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    places = [(track, seed) for track in options.tracks.split(",") for seed in seeds]
    overrides = partial(training_overrides, steps=options.steps, overrides=options.overrides)
    rule = compose_experiment([RULE])[0].stopping
    asked = [
        partial(trained, folder / f"{track}-{seed}", overrides(track, seed, rule="stopping=none"))
        for track, seed in places
    ]
    first, *_ = places
    asked.append(partial(trained, folder / f"{first[0]}-{first[1]}-stopped", overrides(*first, rule=RULE)))
    *full, stopped = at_once(options.jobs, asked)
    runs = []
    for (track, seed), run in zip(places, full, strict=True):
        runs.append({"track": track, "seed": seed, **measure(run, rule, options.trials)})
        last = {key: runs[-1][key] for key in ("rule", "iteration", "saved", "lap_time_loss")}
        print(f"{track} seed {seed}: {last}", flush=True)
    proof = prove(full[0], stopped, runs[0]["iteration"], checkpoint_name(runs[0]["kept"]))
    given = {"steps": options.steps, "trials": options.trials, "overrides": options.overrides}
    return {**summarize(runs), "wanted": WANTED, **given, "really_stopped": proof, "runs": runs}


if __name__ == "__main__":
    main()
