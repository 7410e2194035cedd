"""Sweeps: Optuna studies of experiments."""

DEFAULT_FILE = "sweeps.db"
"""The database of studies, in `runs_dir`; named here because `queue.storage` takes seconds to import."""
PAGE_FILE = "sweep.html"
"""The page of a study, in the folder of its runs."""
