"""Trial claims: which worker makes which trial of a study, decided by one table in the study's own database.

The table is the only record that decides. Optuna's trials, MLflow, best_of_sweep.json and the report are derived from
it and never read back: results go to Optuna by `report_results`, and from there everywhere else.

Optuna's own heartbeat and retry callback (5.0) cannot take its place. They fail a stale trial and add its successor in
two transactions, so a process killed in between loses the trial; a trial whose worker dies before the first heartbeat
never becomes stale; and workers that ask for trials at the same moment exceed the total.
"""

import json
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import sqlalchemy as sa
from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import BaseStorage
from optuna.trial import TrialState
from sqlalchemy.exc import DBAPIError, IntegrityError

from deepracer_exp.sweeps.trial import SeedRun, Trial, as_runs, runs_as_json

TABLE = "deepracer_trials"
_RELEASED = 0.0

_table = sa.Table(
    TABLE,
    sa.MetaData(),
    # The longest study name that Optuna allows.
    sa.Column("study", sa.String(512), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("attempt", sa.Integer, nullable=False),
    sa.Column("owner", sa.String(255), nullable=False),
    # Of Optuna; null until the trial has its result.
    sa.Column("state", sa.String(16)),
    sa.Column("is_reported", sa.Boolean, nullable=False),
    sa.Column("expires_s", sa.Double, nullable=False),
    sa.Column("runs", sa.Text),
    sa.Column("progress", sa.Text),
    sa.Column("objective_values", sa.Text),
)
_of = _table.c
_is_held = _of.state.is_(None)
_waits_for_optuna = sa.and_(_of.state.is_not(None), _of.is_reported.is_(sa.false()))

# Seconds since 1970 by the clock of the database, so that the clocks of the machines do not matter. Read when the row
# is evaluated and not when the transaction begins, because a transaction may wait for another process in between.
_CLOCKS = {
    "sqlite": "((julianday('now') - 2440587.5) * 86400.0)",
    "postgresql": "CAST(EXTRACT(EPOCH FROM clock_timestamp()) AS DOUBLE PRECISION)",
}


@dataclass(frozen=True, kw_only=True)
class Claim:
    """One row of the table: a trial, the worker that owns it, and the runs of earlier owners."""

    trial: Trial
    attempt: int
    """1 for the first owner, one more for each takeover."""
    owner: str
    is_reported: bool
    """Whether Optuna has the result of the trial."""
    progress: dict[str, Any]
    expired: bool
    """Whether the lease has run out, so that any worker may take the trial over."""

    @property
    def has_ended(self) -> bool:
        """Whether the trial has its result."""
        return self.trial.state != "RUNNING"

    def is_final_as(self, number: int) -> bool:
        """Return whether this is the claim of the trial of that number, and its row never changes again."""
        return self.trial.number == number and self.has_ended and self.is_reported


class TrialClaims:
    """The claims of one study.

    Each change is a single statement that names the state it expects, and is read back in the same transaction. So a
    change can be repeated if the connection broke before its answer.
    """

    def __init__(self, engine: sa.Engine, study: str):
        """Create the table in the study's database if it is missing."""
        self.study = study
        self._engine = engine
        self._final: list[Claim] = []
        """The first claims, of the trials 0, 1, ..., whose rows never change again."""
        self._now = sa.literal_column(_CLOCKS[engine.dialect.name], sa.Double)
        if sa.inspect(engine).has_table(TABLE):
            return
        try:
            _table.create(engine)
        except DBAPIError:
            # Another process was faster; each database reports that in its own way.
            if not sa.inspect(engine).has_table(TABLE):
                raise

    def claim(self, owner: str, total: int, lease_s: float) -> Claim | None:
        """Claim a trial for an owner, who may hold one at a time.

        In this order: the trial that it holds already (the answer to its first claim was lost), one whose lease has
        run out, a new one of the study's `total`; None if no trial is free now.
        """
        lost = 0
        while True:
            rows, free = self._open_to(owner, total)
            for row in rows:
                if row.owner == owner and not row.expired:
                    return _as_claim(row)
            for row in rows:
                if row.expired and (claim := self._take_over(row, owner, lease_s)) is not None:
                    return claim
            if not free:
                return None
            # In order; workers that raced for the same trial spread out.
            number = random.choice(free[: 1 + 2 * lost])
            if (claim := self._begin(number, owner, lease_s)) is not None:
                return claim
            lost += 1

    def renew(self, claim: Claim, lease_s: float, progress: Mapping[str, Any] | None = None) -> bool:
        """Restart the lease of a claim; return False if another worker has taken it over.

        A lease that has run out can still be renewed until another worker takes the trial over. `progress` is for the
        live view; None: unchanged.
        """
        more = {} if progress is None else {_of.progress: json.dumps(dict(progress))}
        return self._update_held(claim, {_of.expires_s: self._now + lease_s, **more})

    def record(
        self,
        claim: Claim,
        runs: Sequence[SeedRun],
        progress: Mapping[str, Any] | None = None,
    ) -> bool:
        """Record the runs for a later owner; return False if another worker has taken the trial over."""
        more = {} if progress is None else {_of.progress: json.dumps(dict(progress))}
        return self._update_held(claim, {_of.runs: json.dumps(runs_as_json(runs)), **more})

    def settle(self, claim: Claim, ended: Trial) -> bool:
        """Store the result of a trial; return False if another worker has taken the trial over.

        Repeated calls return True and the first result stays.
        """
        values = {
            _of.state: ended.state,
            _of.objective_values: json.dumps(ended.values),
            _of.runs: json.dumps(runs_as_json(ended.runs)),
        }
        return self._update_held(claim, values, settled=True)

    def unreported(self) -> list[Claim]:
        """Return the claims whose result Optuna does not have yet."""
        return [_as_claim(row) for row in self._rows(_waits_for_optuna)]

    def mark_reported(self, number: int) -> None:
        """Record that Optuna has the result of a trial."""
        with self._engine.begin() as connection:
            where = (_of.number == number, _waits_for_optuna)
            connection.execute(self._statement({_of.is_reported: True}, *where))

    def release(self, owner: str, *, is_lost: bool = False) -> int:
        """End the leases of an owner that is gone or about to end; return their number.

        If its process died unasked (`is_lost`), perhaps because of its trial, the attempts at its run stay counted;
        otherwise they start again from zero.
        """
        where = (_of.owner == owner, _is_held, _of.expires_s > _RELEASED)
        with self._engine.begin() as connection:
            mine = connection.execute(self._select(*where)).all()
            for row in mine:
                runs = [run if is_lost else replace(run, tries=0) for run in _runs(row)]
                values = {_of.expires_s: _RELEASED, _of.runs: json.dumps(runs_as_json(runs))}
                connection.execute(self._statement(values, _of.number == row.number, *where))
        return len(mine)

    def forget(self) -> None:
        """Delete the claims."""
        with self._engine.begin() as connection:
            connection.execute(sa.delete(_table).where(_of.study == self.study))

    def all(self) -> list[Claim]:
        """Return all claims by the number of the trial, reading only those that may have changed."""
        final = self._final
        claims = [*final, *map(_as_claim, self._rows(_of.number >= len(final)))]
        while len(final) < len(claims) and claims[len(final)].is_final_as(len(final)):
            final.append(claims[len(final)])
        return claims

    def is_done(self, total: int) -> bool:
        """Return whether the first `total` trials have their results."""
        ended = sa.select(sa.func.count()).where(
            _of.study == self.study, _of.number < total, _of.state.is_not(None)
        )
        with self._engine.connect() as connection:
            return connection.execute(ended).scalar_one() >= total

    def _open_to(self, owner: str, total: int) -> tuple[list[sa.Row[Any]], list[int]]:
        """Return the claims that an owner holds or may take over, and the numbers of trials never claimed.

        A worker without work asks every second, so this reads few rows however many the study has.
        """
        within = (_of.study == self.study, _of.number < total)
        mine = (_is_held, sa.or_(_of.owner == owner, _of.expires_s <= self._now))
        with self._engine.connect() as connection:
            rows = list(connection.execute(self._select(_of.number < total, *mine)).all())
            if connection.execute(sa.select(sa.func.count()).where(*within)).scalar_one() >= total:
                return rows, []
            taken = set(connection.execute(sa.select(_of.number).where(*within)).scalars())
        return rows, [number for number in range(total) if number not in taken]

    def _rows(self, *where: sa.ColumnElement[bool]) -> list[sa.Row[Any]]:
        with self._engine.connect() as connection:
            return list(connection.execute(self._select(*where)).all())

    def _select(self, *where: sa.ColumnElement[bool]) -> sa.Select[Any]:
        expired = sa.and_(_is_held, _of.expires_s <= self._now).label("expired")
        return sa.select(_table, expired).where(_of.study == self.study, *where).order_by(_of.number)

    def _statement(self, values: Mapping[Any, Any], *where: sa.ColumnElement[bool]) -> sa.Update:
        return sa.update(_table).where(_of.study == self.study, *where).values(dict(values))

    def _begin(self, number: int, owner: str, lease_s: float) -> Claim | None:
        new = sa.insert(_table).values(
            study=self.study,
            number=number,
            attempt=1,
            owner=owner,
            is_reported=False,
            expires_s=self._now + lease_s,
        )
        try:
            with self._engine.begin() as connection:
                connection.execute(new)
                return _as_claim(connection.execute(self._select(_of.number == number)).one())
        except IntegrityError:
            return None

    def _take_over(self, seen: sa.Row[Any], owner: str, lease_s: float) -> Claim | None:
        taken = {_of.owner: owner, _of.attempt: seen.attempt + 1, _of.expires_s: self._now + lease_s}
        as_seen = (
            _of.number == seen.number,
            _of.attempt == seen.attempt,
            _of.owner == seen.owner,
            _is_held,
            _of.expires_s <= self._now,
        )
        with self._engine.begin() as connection:
            connection.execute(self._statement(taken, *as_seen))
            row = connection.execute(self._select(_of.number == seen.number)).one()
        mine = (row.owner, row.attempt, row.state) == (owner, seen.attempt + 1, None)
        return _as_claim(row) if mine else None

    def _update_held(self, claim: Claim, values: Mapping[Any, Any], *, settled: bool = False) -> bool:
        """Change a claim if its owner still holds it; return whether it does, and the trial has its result or not."""
        held = (
            _of.number == claim.trial.number,
            _of.owner == claim.owner,
            _of.attempt == claim.attempt,
            _is_held,
        )
        with self._engine.begin() as connection:
            if values:
                connection.execute(self._statement(values, *held))
            row = connection.execute(self._select(_of.number == claim.trial.number)).one()
        return (row.owner, row.attempt) == (claim.owner, claim.attempt) and settled == (row.state is not None)


def report_results(claims: TrialClaims, storage: BaseStorage) -> None:
    """Report to Optuna the results it does not have yet; the worker of one may have been killed before it could."""
    for claim in claims.unreported():
        trial = claim.trial
        study_id = storage.get_study_id_from_name(claims.study)
        trial_id = storage.get_trial_id_from_study_id_trial_number(study_id, trial.number)
        try:
            for key, value in {**trial.attributes(), "attempt": claim.attempt}.items():
                storage.set_trial_user_attr(trial_id, key, value)
            # Not by a method of `Study`, which ends the process's study with the last point of a grid.
            state, values = TrialState[trial.state], trial.values
            if state == TrialState.PRUNED:
                # Optuna records the last value of a pruned trial as its result.
                pruned = storage.get_trial(trial_id)
                step = pruned.last_step
                values = None if step is None else [pruned.intermediate_values[step]]
            storage.set_trial_state_values(trial_id, state, values)
        except UpdateFinishedTrialError:
            pass  # another process was faster, with the same result
        claims.mark_reported(trial.number)


def _runs(row: sa.Row[Any]) -> tuple[SeedRun, ...]:
    return as_runs(json.loads(row.runs or "[]"))


def _as_claim(row: sa.Row[Any]) -> Claim:
    values = json.loads(row.objective_values or "null")
    return Claim(
        trial=Trial(number=row.number, state=row.state or "RUNNING", values=values, runs=_runs(row)),
        attempt=row.attempt,
        owner=row.owner,
        is_reported=row.is_reported,
        progress=json.loads(row.progress or "{}"),
        expired=bool(row.expired),
    )
