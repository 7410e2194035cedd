"""What is said when a run has ended."""

import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from deepracer_exp.training.outcome import Outcome

_RESULTS = {
    "report.html": "what was found, and all figures",
    "best_lap.png": "the fastest lap",
    "learning.png": "the learning curves",
}


def tell(outcome: "Outcome", tracked_in: str | None) -> None:
    """Print how a run ended, and where its results are.

    Args:
        outcome: of the run.
        tracked_in: folder of the runs whose MLflow pages have it, None where it was not recorded.
    """
    from deepracer_exp.formats.run_result import result_of

    summary = outcome.summary
    if outcome.status == "failed":
        print(f"deepracer-exp: run failed: {outcome.reason}", file=sys.stderr)
        print(f"  what is known: {outcome.folder}", file=sys.stderr)
        return
    print(f"\n{outcome.status}: {outcome.reason}")
    print(
        f"  {_count(summary['iteration'], 'iteration')}, {_count(summary['env_steps'], 'step')} in "
        f"{summary['wall_clock_s']:.0f} s; while exploring {_count(summary['episodes'], 'episode')}, {_laps(summary)}"
    )
    result = result_of(summary)
    if result is not None and result.evaluated:
        print(f"\n  best policy   checkpoint {result.iteration:06d}, evaluated: {result.words()}")
    print(f"\n  results       {outcome.folder}")
    for name, what in _RESULTS.items():
        if (outcome.folder / name).exists():
            print(f"    {name:12}  {what}")
    if outcome.note is not None:
        print(f"warning: {outcome.note}", file=sys.stderr)
    if tracked_in is not None:
        command = _command()
        where = "" if tracked_in == "runs" else f" --runs-dir {shlex.quote(tracked_in)}"
        print(f"  compare runs  {command} ui{where}")
    _print_next_steps(outcome)


def tell_all(outcomes: "Sequence[Outcome]") -> None:
    """Print a line a run."""
    print(f"\n{len(outcomes)} runs:")
    for outcome in outcomes:
        print(f"  {outcome.folder.name}  {outcome.status}  {_laps(outcome.summary)}  {outcome.reason}")


def _print_next_steps(outcome: "Outcome") -> None:
    from deepracer_exp.analysis.next_steps import COMMAND, next_steps

    steps = [
        (line.replace(COMMAND, _command(), 1), what)
        for line, what in next_steps(outcome.folder, outcome.summary)
    ]
    if steps:
        print("\n  next")
    width = max((len(line) for line, _ in steps), default=0)
    for line, what in steps:
        print(f"    {line:{width}}  # {what}")


def _command() -> str:
    # `make race` calls us by a path that a newcomer's shell does not know.
    return "deepracer-exp" if shutil.which("deepracer-exp") else shlex.quote(sys.argv[0])


def _laps(summary: Mapping[str, Any]) -> str:
    """Say what a run's laps came to."""
    tracks = summary.get("tracks")
    if tracks is not None:
        return f"laps on {sum(track['laps'] > 0 for track in tracks.values())} of {len(tracks)} tracks"
    best = summary["best_lap_time_s"]
    return f"{_count(summary['laps'], 'lap')}, the fastest in {best:.2f} s" if best is not None else "no lap"


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' * (number != 1)}"
