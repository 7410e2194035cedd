"""Which iterations to submit."""

import pandas as pd

from deepracer_exp.deepracer.recording import Recording

from .log_view import LogView

LEAST_LAPS = 3
"""Complete laps of an iteration below which its 25th percentile means nothing."""
DENSE = 0.5
"""Share of complete laps an iteration must have, over the highest share of an iteration with `LEAST_LAPS`."""
MOST = 3


def candidates_of(view: LogView) -> pd.DataFrame:
    """Return the candidates of a log; none of our own runs, which keep few checkpoints and have evaluated them."""
    return candidates(view.iterations if view.recording.best is None else view.iterations.iloc[:0])


def candidates(iterations: pd.DataFrame) -> pd.DataFrame:
    """Return the iterations whose policy is worth submitting, the best first, at most `MOST`.

    Fast and dense (after TheRayG/deepracer-log-analysis): at least `LEAST_LAPS` complete laps, and `DENSE` of the
    highest share of complete laps among these; of them the ones with the lowest 25th percentile of the lap time.
    """
    enough = iterations["lap_time_p25_s"].notna() & (iterations["complete"] >= LEAST_LAPS)
    dense = iterations["lap_share"] >= DENSE * iterations.loc[enough, "lap_share"].max()
    return iterations[enough & dense].sort_values("lap_time_p25_s", kind="stable").head(MOST)


def evaluated_candidates(recording: Recording) -> pd.DataFrame:
    """Return the iterations after which the service's evaluation completed every lap it tried, the fastest first.

    Returns:
        By iteration: `laps` and `lap_time_s`, their mean.
    """
    rows = recording.metrics
    groups = rows[(rows["phase"] == "evaluation") & (rows["stream"] == "training")].groupby("iteration")
    found = pd.DataFrame({"laps": groups.size(), "lap_time_s": groups["time_s"].mean()})
    return found[groups["completion"].min() >= 100.0].sort_values("lap_time_s", kind="stable")
