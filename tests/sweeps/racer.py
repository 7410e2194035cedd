"""A process of the tests of `sweeps`: `python racer.py WHAT URL OWNER ...`; begins at a line on its stdin."""

import sys
from pathlib import Path

import sqlalchemy as sa

sys.path.insert(0, str(Path(__file__).parents[2]))

from sweeps.claims import TrialClaims
from sweeps.storage import resolve_database


def _ready() -> None:
    print("ready", flush=True)
    sys.stdin.readline()


def claim(url: str, owner: str, total: str, lease_s: str) -> None:
    """Claim trials, each under another name, until there are none."""
    engine = sa.create_engine(url, **resolve_database(url, Path()).engine_options())
    _ready()
    claims = TrialClaims(engine, "study")
    count = 0
    while (claim := claims.claim(f"{owner}.{count}", int(total), float(lease_s))) is not None:
        print(claim.index, claim.attempt, claim.trial_id, flush=True)
        count += 1


def storage(url: str, owner: str, trials: str) -> None:
    """Open the storage, make the study if it is missing, make trials and end them."""
    import optuna

    from sweeps.storage import open_storage

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    _ready()
    storage = open_storage(url, Path())
    TrialClaims(storage.engine, "study")
    study = optuna.create_study(study_name="study", storage=storage.optuna, load_if_exists=True)
    for _ in range(int(trials)):
        trial = study.ask()
        trial.suggest_float("lr", 1e-5, 1e-3, log=True)
        trial.report(1.0, 1)
        study.tell(trial, 1.0)
        print(trial.number, flush=True)


if __name__ == "__main__":
    {"claim": claim, "storage": storage}[sys.argv[1]](*sys.argv[2:])
