"""Sweeps: Optuna studies of experiments."""

DEFAULT_FILE = "sweeps.db"
"""The database of studies, in `runs_dir`; named here because `queue.storage` takes seconds to import."""
