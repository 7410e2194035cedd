"""Who makes which trial of a study, in the study's own database: each slot has one owner at a time."""

import json
import random
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import mysql
from sqlalchemy.exc import DBAPIError, IntegrityError

_TABLE = "deepracer_slots"
_CLAIMED, _SETTLED, _TOLD = "claimed", "settled", "told"
_RELEASED = 0.0

_Json = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")

_slots = sa.Table(
    _TABLE,
    sa.MetaData(),
    # Optuna's length of a study's name, and MySQL's of a key.
    sa.Column("study", sa.String(512), primary_key=True),
    sa.Column("slot", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("attempt", sa.Integer, nullable=False),
    sa.Column("owner", sa.String(255), nullable=False),
    sa.Column("previous_owner", sa.String(255)),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("expires_s", sa.Double, nullable=False),
    sa.Column("trial_id", sa.Integer),
    sa.Column("runs", _Json),
    sa.Column("progress", _Json),
    sa.Column("outcome", sa.String(16)),
    sa.Column("objective_values", _Json),
    sa.Column("attrs", _Json),
)
_of = _slots.c

# Seconds since 1970 by the clock of the database, so that the machines' own clocks do not matter. At the moment the
# row is looked at, not at the beginning of the transaction: in between it may have waited for another process.
_CLOCKS = {
    "sqlite": "((julianday('now') - 2440587.5) * 86400.0)",
    "postgresql": "CAST(EXTRACT(EPOCH FROM clock_timestamp()) AS DOUBLE PRECISION)",
    "mysql": "(TIMESTAMPDIFF(MICROSECOND, '1970-01-01', UTC_TIMESTAMP(6)) / 1000000.0)",
}


@dataclass(frozen=True)
class Claim:
    """A slot that an owner holds, with what its earlier owners left."""

    study: str
    slot: int
    attempt: int
    """1 for the first owner, one more each time that it is taken over."""
    owner: str
    trial_id: int | None
    runs: tuple[dict[str, Any], ...]
    previous_owner: str | None


@dataclass(frozen=True)
class Slot:
    """How a slot stands."""

    slot: int
    attempt: int
    owner: str
    state: str
    """`claimed`, `settled` (has its result) or `told` (Optuna has it, too)."""
    outcome: str | None
    values: list[float] | None
    attrs: dict[str, Any]
    trial_id: int | None
    runs: tuple[dict[str, Any], ...]
    progress: dict[str, Any]
    expired: bool
    """Whether it is claimed and anybody may take it over."""


class Ledger:
    """The slots of one study.

    Every change is one statement that names the state it expects; what it has done is read back in the same
    transaction. So each of them can be repeated when its answer was lost with the connection.
    """

    def __init__(self, engine: sa.Engine, study: str):
        """Make the table if it is missing.

        Args:
            engine: of the study's database.
            study: its name.
        """
        self._engine, self._study = engine, study
        self._now = sa.literal_column(_CLOCKS[engine.dialect.name], sa.Double)
        if sa.inspect(engine).has_table(_TABLE):
            return
        try:
            _slots.create(engine)
        except DBAPIError:
            # Another process was faster; each database has its own word for it.
            if not sa.inspect(engine).has_table(_TABLE):
                raise

    def claim(self, owner: str, total: int, lease_s: float) -> Claim | None:
        """Give a slot to an owner, who may hold one at a time.

        First the one that it holds already (it never got the answer), then one whose lease has run out, then a new
        one.

        Args:
            owner: no other worker has this name or ever will.
            total: slots that there shall be.
            lease_s: how long it holds without being renewed.

        Returns:
            None: nothing is free now.
        """
        lost = 0
        while True:
            rows, free = self._open_to(owner, total)
            for row in rows:
                if row.owner == owner and not row.expired:
                    return self._as_claim(row)
            for row in rows:
                if row.expired and (claim := self._take_over(row, owner, lease_s)) is not None:
                    return claim
            if not free:
                return None
            # In order; processes that want the same one spread out.
            slot = random.choice(free[: 1 + 2 * lost])
            if self._begin(slot, owner, lease_s):
                return Claim(self._study, slot, 1, owner, None, (), None)
            lost += 1

    def renew(self, claim: Claim, lease_s: float, progress: Mapping[str, Any] | None = None) -> bool:
        """Begin the lease of a claim anew; return False if somebody else has taken it over.

        A lease that has run out can be renewed while nobody else has taken the slot.

        Args:
            claim: of the caller.
            lease_s: how long it holds from now.
            progress: how far the trial is, for the live table; None: as it was.
        """
        more = {} if progress is None else {_of.progress: json.dumps(dict(progress))}
        return self._swap(claim, {_of.expires_s: self._now + lease_s, **more}, (_CLAIMED,))

    def note(
        self, claim: Claim, *, trial_id: int | None = None, runs: list[dict[str, Any]] | None = None
    ) -> bool:
        """Write down what whoever takes over must know; return False if somebody else has taken over already."""
        values: dict[sa.Column[Any], Any] = {}
        if trial_id is not None:
            values[_of.trial_id] = trial_id
        if runs is not None:
            values[_of.runs] = json.dumps(runs)
        return self._swap(claim, values, (_CLAIMED,))

    def settle(
        self, claim: Claim, outcome: str, values: list[float] | None, attrs: Mapping[str, Any]
    ) -> bool:
        """Give a slot its result; return False if somebody else has taken it over.

        The first result of an attempt stays; True again if it has one.

        Args:
            claim: of the caller.
            outcome: COMPLETE, PRUNED or FAIL.
            values: one for each objective, or None.
            attrs: what Optuna is told of the trial besides.
        """
        result = {
            _of.state: _SETTLED,
            _of.outcome: outcome,
            _of.objective_values: json.dumps(values),
            _of.attrs: json.dumps(dict(attrs)),
        }
        return self._swap(claim, result, (_SETTLED, _TOLD))

    def settled(self) -> list[Slot]:
        """Return the slots whose result Optuna has not been told yet."""
        return [_as_slot(row) for row in self._rows(_of.state == _SETTLED)]

    def mark_told(self, slot: int) -> None:
        """Write down that Optuna has the result of a slot."""
        self._update({_of.state: _TOLD}, _of.slot == slot, _of.state == _SETTLED)

    def release(self, owner: str, *, is_lost: bool = False) -> int:
        """End the leases of an owner that is gone, or is about to go; return how many there were.

        Args:
            owner: that holds them.
            is_lost: its process died and nobody had asked it to: its trial may be the reason, and the tries of its
                run count. Else they begin again.
        """
        where = (_of.owner == owner, _of.state == _CLAIMED, _of.expires_s > _RELEASED)
        with self._engine.begin() as connection:
            mine = connection.execute(self._select(*where)).all()
            for row in mine:
                runs = [run if is_lost else {**run, "tries": 0} for run in _runs(row)]
                values = {_of.expires_s: _RELEASED, _of.runs: json.dumps(runs)}
                connection.execute(self._statement(values, _of.slot == row.slot, *where))
        return len(mine)

    def slots(self) -> list[Slot]:
        """Return all slots that anybody has ever claimed, by number."""
        return [_as_slot(row) for row in self._rows()]

    def is_done(self, total: int) -> bool:
        """Return whether all slots below `total` have their result."""
        ended = sa.select(sa.func.count()).where(
            _of.study == self._study, _of.slot < total, _of.state.in_((_SETTLED, _TOLD))
        )
        with self._engine.connect() as connection:
            return connection.execute(ended).scalar_one() >= total

    def _open_to(self, owner: str, total: int) -> tuple[list[sa.Row[Any]], list[int]]:
        """Return the slots that an owner holds or may take over, and those that nobody has ever claimed.

        Whoever finds nothing to do asks again and again: it reads few rows, however many the study has.
        """
        within = (_of.study == self._study, _of.slot < total)
        mine = (_of.state == _CLAIMED, sa.or_(_of.owner == owner, _of.expires_s <= self._now))
        with self._engine.connect() as connection:
            rows = list(connection.execute(self._select(_of.slot < total, *mine)).all())
            if connection.execute(sa.select(sa.func.count()).where(*within)).scalar_one() >= total:
                return rows, []
            taken = set(connection.execute(sa.select(_of.slot).where(*within)).scalars())
        return rows, [slot for slot in range(total) if slot not in taken]

    def _rows(self, *where: sa.ColumnElement[bool]) -> list[sa.Row[Any]]:
        with self._engine.connect() as connection:
            return list(connection.execute(self._select(*where)).all())

    def _select(self, *where: sa.ColumnElement[bool]) -> sa.Select[Any]:
        expired = sa.and_(_of.state == _CLAIMED, _of.expires_s <= self._now).label("expired")
        return sa.select(_slots, expired).where(_of.study == self._study, *where).order_by(_of.slot)

    def _statement(self, values: Mapping[Any, Any], *where: sa.ColumnElement[bool]) -> sa.Update:
        return sa.update(_slots).where(_of.study == self._study, *where).values(dict(values))

    def _update(self, values: Mapping[Any, Any], *where: sa.ColumnElement[bool]) -> None:
        with self._engine.begin() as connection:
            connection.execute(self._statement(values, *where))

    def _begin(self, slot: int, owner: str, lease_s: float) -> bool:
        new = sa.insert(_slots).values(
            study=self._study,
            slot=slot,
            attempt=1,
            owner=owner,
            state=_CLAIMED,
            expires_s=self._now + lease_s,
        )
        try:
            with self._engine.begin() as connection:
                connection.execute(new)
        except IntegrityError:
            return False
        return True

    def _take_over(self, seen: sa.Row[Any], owner: str, lease_s: float) -> Claim | None:
        taken = {
            _of.owner: owner,
            _of.previous_owner: seen.owner,
            _of.attempt: seen.attempt + 1,
            _of.expires_s: self._now + lease_s,
        }
        as_seen = (
            _of.slot == seen.slot,
            _of.attempt == seen.attempt,
            _of.owner == seen.owner,
            _of.state == _CLAIMED,
            _of.expires_s <= self._now,
        )
        with self._engine.begin() as connection:
            connection.execute(self._statement(taken, *as_seen))
            row = connection.execute(self._select(_of.slot == seen.slot)).one()
        mine = (row.owner, row.attempt, row.state) == (owner, seen.attempt + 1, _CLAIMED)
        return self._as_claim(row) if mine else None

    def _swap(self, claim: Claim, values: Mapping[Any, Any], afterwards: tuple[str, ...]) -> bool:
        """Change the slot of a claim if it is still held; return whether it is, and then is in one of the states."""
        held = (
            _of.slot == claim.slot,
            _of.owner == claim.owner,
            _of.attempt == claim.attempt,
            _of.state == _CLAIMED,
        )
        with self._engine.begin() as connection:
            if values:
                connection.execute(self._statement(values, *held))
            row = connection.execute(self._select(_of.slot == claim.slot)).one()
        return (row.owner, row.attempt) == (claim.owner, claim.attempt) and row.state in afterwards

    def _as_claim(self, row: sa.Row[Any]) -> Claim:
        return Claim(
            self._study, row.slot, row.attempt, row.owner, row.trial_id, _runs(row), row.previous_owner
        )


def _runs(row: sa.Row[Any]) -> tuple[dict[str, Any], ...]:
    return tuple(json.loads(row.runs)) if row.runs else ()


def _as_slot(row: sa.Row[Any]) -> Slot:
    return Slot(
        slot=row.slot,
        attempt=row.attempt,
        owner=row.owner,
        state=row.state,
        outcome=row.outcome,
        values=json.loads(row.objective_values) if row.objective_values else None,
        attrs=json.loads(row.attrs) if row.attrs else {},
        trial_id=row.trial_id,
        runs=_runs(row),
        progress=json.loads(row.progress) if row.progress else {},
        expired=bool(row.expired),
    )
