"""What the processes do that race in the tests of `sweeps`: wait at the start line, and write a line for each trial."""

from multiprocessing.synchronize import Barrier
from pathlib import Path

import optuna
import sqlalchemy as sa

from deepracer_exp.sweeps.queue.claims import TrialClaims
from deepracer_exp.sweeps.queue.storage import open_storage, resolve_database


def claim_all(url: str, file: Path, start: Barrier, total: int, lease_s: float) -> None:
    """Claim trials, each under another name, until there are none."""
    engine = sa.create_engine(url, **resolve_database(url, Path()).engine_options())
    start.wait()
    claims, count = TrialClaims(engine, "study"), 0
    with file.open("w", buffering=1) as out:
        while (claim := claims.claim(f"{file.name}.{count}", total, lease_s)) is not None:
            print(claim.trial.number, claim.attempt, len(claim.trial.runs), file=out)
            count += 1


def make_trials(url: str, file: Path, start: Barrier, trials: int) -> None:
    """Open the storage, make the study if it is missing, make trials and end them."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    start.wait()
    storage = open_storage(url, Path())
    TrialClaims(storage.engine, "study")
    study = optuna.create_study(study_name="study", storage=storage, load_if_exists=True)
    with file.open("w", buffering=1) as out:
        for _ in range(trials):
            trial = study.ask()
            trial.suggest_float("lr", 1e-5, 1e-3, log=True)
            trial.report(1.0, 1)
            study.tell(trial, 1.0)
            print(trial.number, file=out)
