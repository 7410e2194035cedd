"""The terms of a reward function, for the page of a recording."""

from dataclasses import replace

import pandas as pd

from deepracer_exp.analysis.log_view import LogView
from deepracer_exp.env.reward_source import is_of_zoo
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.recording import LogProblem

from .reward_terms import recorded_source, reward_terms


def run_terms(view: LogView, just_trained: bool = False) -> tuple[LogView, pd.DataFrame | None]:
    """Return what each term of its reward function contributed to a recorded training, and the view.

    A reward function is a program, and a recording may come from anywhere: only one of the reward zoo is run.

    Args:
        view: the training.
        just_trained: it has been run by this process, in the training itself.

    Returns:
        The view, with a problem more where the terms could not be told; the terms as `reward_terms` gives them.
    """
    source = recorded_source(view.recording)
    if source is None or not (just_trained or is_of_zoo(source.text)):
        return view, None
    try:
        return view, reward_terms(view, source)
    except BadInput as error:
        return replace(view, problems=(*view.problems, LogProblem(view.name, None, str(error)))), None
