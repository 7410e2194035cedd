"""What is being trained, in words for the view of it."""

from collections.abc import Mapping

from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.tracking.names import joined

from .budget import Budget
from .display import RunHeader
from .results import Results
from .run_folder import RunFolder


def run_header(
    folder: RunFolder, setup: RaceSetup, names: Mapping[str, str], results: Results, budget: Budget
) -> RunHeader:
    """Return the header of a run's view.

    Args:
        folder: where the results go.
        setup: the files of the experiment, read.
        names: what a racer calls its choices.
        results: know how tracks are told apart.
        budget: of the run.
    """
    return RunHeader(
        name=folder.name,
        track=joined([course.tracks[0].title for course in setup.courses], " + "),
        track_labels=tuple(results.labels),
        remembered=results.remembered,
        reward=names["reward"],
        network=names["network"],
        actions=names["action_space"],
        budget=str(budget),
        folder=str(folder.path),
    )


def track_names(setup: RaceSetup) -> list[str]:
    """Return what the courses are called: one by its own name, which may stand in a file; several by their options."""
    courses = setup.courses
    return [course.name for course in courses] if len(courses) > 1 else [setup.track.name]
