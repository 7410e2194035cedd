"""The pictures at the end of a run."""

from pathlib import Path

from deepracer_exp.formats.trace import read_trace
from deepracer_exp.tracks.track import Track


def write_report(run_dir: Path, track: Track) -> None:
    """Draw `best_lap.png` and `learning.png` from the run's trace and metrics."""
    # Half a second of import that no training waits for.
    import pandas as pd

    from deepracer_exp.analysis.figures import LINE_COLUMNS, driven_line, learning_curves

    metrics_file = run_dir / "metrics.jsonl"
    if not metrics_file.is_file():
        return
    driven_line(read_trace(run_dir / "trace", LINE_COLUMNS), track).savefig(run_dir / "best_lap.png", dpi=120)
    learning_curves(pd.read_json(metrics_file, lines=True)).savefig(run_dir / "learning.png", dpi=120)
