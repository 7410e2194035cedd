"""The terms of a reward function, for the page of a run of ours."""

from dataclasses import replace

import pandas as pd

from deepracer_exp.analysis.log_view import LogView
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.own_recording import is_own_run
from deepracer_exp.formats.recording import LogProblem

from .reward_terms import recorded_source, reward_terms


def run_terms(view: LogView) -> tuple[LogView, pd.DataFrame | None]:
    """Return what each term of its reward function contributed to a run of ours, and the view.

    A reward function is a program. That of a run of ours was run before, in its training; that of a log from elsewhere
    is not run.

    Returns:
        The view, with a problem more where the terms could not be told; the terms as `reward_terms` gives them.
    """
    source = recorded_source(view.recording)
    if source is None or not any(is_own_run(file.parent) for file in view.recording.files):
        return view, None
    try:
        return view, reward_terms(view, source)
    except BadInput as error:
        return replace(view, problems=(*view.problems, LogProblem(view.name, None, str(error)))), None
