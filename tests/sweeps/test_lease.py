"""Leases that a driver renews for its workers, and those that it does not."""

import multiprocessing

import pytest
import sqlalchemy as sa

from deepracer_exp.sweeps.queue.claims import TrialClaims
from deepracer_exp.sweeps.queue.launcher import newest_beat
from deepracer_exp.sweeps.queue.lease import Answer, Beat, Lease, LeaseKeeper
from deepracer_exp.sweeps.trial import Trial
from deepracer_exp.training.callback import TakenOver
from tests.waiting import wait_until

HOUR_S = 3600.0


class Counted(TrialClaims):
    """Claims that count the renewals which a worker makes itself."""

    own = 0

    def renew(self, *arguments) -> bool:
        self.own += 1
        return super().renew(*arguments)


class Worker:
    """A worker as its driver sees it."""

    def __init__(self, line):
        self.line = line

    def hear(self) -> Beat | None:
        return newest_beat(self.line)

    def answer(self, answer: Answer) -> None:
        self.line.send(answer)


@pytest.fixture
def worker(engine, claims):
    """The claims as a worker has them, which counts its own renewals."""
    return Counted(engine, claims.study)


@pytest.fixture
def statements(engine):
    """Every statement that the database is sent."""
    sent = []
    sa.event.listen(engine, "after_cursor_execute", lambda *what: sent.append(what[2]))
    return sent


def test_one_statement_renews_the_leases_of_all_workers(claims, statements):
    names = ("anna", "ben", "cleo", "dora")
    anna, ben, cleo, dora = (claims.claim(name, 4, HOUR_S) for name in names)
    claims.renew(cleo, HOUR_S, {"completion": 7.0})
    for claim in (anna, ben, cleo):
        claims.renew(claim, 0.0)
    assert claims.settle(dora, Trial(number=3, state="PRUNED", values=None, runs=()))
    taken = claims.claim("heir", 4, HOUR_S)
    assert taken.trial.number == 0
    statements.clear()
    shown = {anna.held: None, ben.held: {"completion": 50.0}, cleo.held: None, dora.held: {"completion": 1.0}}
    assert claims.renew_all(shown, HOUR_S) == {ben.held, cleo.held}
    assert len(statements) == 1
    found = claims.all()
    assert [claim.expired for claim in found] == [False] * 4
    assert [claim.owner for claim in found] == ["heir", "ben", "cleo", "dora"]
    assert [claim.progress for claim in found] == [{}, {"completion": 50.0}, {"completion": 7.0}, {}]


def test_a_late_sign_of_life_of_a_worker_that_is_gone_renews_nothing(claims):
    claim = claims.claim("gone", 1, HOUR_S)
    claims.release("gone", is_lost=True)
    assert claims.renew_all({claim.held: {}}, HOUR_S) == set()
    assert claims.claim("heir", 1, HOUR_S).attempt == 2


def test_a_worker_that_its_driver_hears_sends_the_database_nothing(worker, claims):
    ours, theirs = multiprocessing.Pipe()
    claim, lease_s = claims.claim("one", 1, 24.0), 24.0
    keeper = LeaseKeeper(claims, lease_s, lambda: [Worker(ours)])
    with Lease(worker, claim, lease_s, HOUR_S, theirs) as lease:
        for iteration in (1, 2, 3):
            lease.progress = {"iteration": iteration}
            wait_until(lambda: keeper.renew() or claims.all()[0].progress == lease.progress, "renewal")
        lease.confirm()
    assert worker.own == 0


def test_a_worker_that_is_not_heard_loses_its_lease_however_well_its_driver_is(claims):
    ours, _theirs = multiprocessing.Pipe()
    claims.claim("hangs", 1, 0.5)
    with LeaseKeeper(claims, 0.5, lambda: [Worker(ours)]):
        assert wait_until(lambda: claims.claim("heir", 1, HOUR_S), "end of the lease").attempt == 2


@pytest.mark.parametrize("driver", ["suspended", "gone"])
def test_a_worker_without_an_answer_renews_its_lease_itself(worker, claims, driver):
    ours, theirs = multiprocessing.Pipe()
    claim = claims.claim("one", 1, 3.0)
    if driver == "gone":
        ours.close()
    with Lease(worker, claim, 3.0, HOUR_S, theirs) as lease:
        lease.progress = {"iteration": 1}
        wait_until(lambda: worker.own >= 2, "renewals")
        assert claims.all()[0].progress == lease.progress
        lease.confirm()
    # One sign of life is on the line, and no more: the line of a driver that sleeps for hours never fills.
    assert driver == "gone" or (ours.recv().held == claim.held and not ours.poll())


def test_a_worker_whose_trial_was_taken_over_hears_it_from_its_driver(worker, claims):
    ours, theirs = multiprocessing.Pipe()
    late = claims.claim("late", 1, 0.0)
    assert claims.claim("heir", 1, HOUR_S).attempt == 2
    lease_s = 24.0
    keeper = LeaseKeeper(claims, lease_s, lambda: [Worker(ours)])

    def is_lost() -> bool:
        keeper.renew()
        try:
            lease.confirm()
        except TakenOver:
            return True
        return False

    with Lease(worker, late, lease_s, HOUR_S, theirs) as lease:
        wait_until(is_lost, "loss")


def test_what_ended_is_read_once_and_every_change_is_seen(claims, statements):
    def settled(number: int) -> None:
        claim = claims.claim("one", 5, HOUR_S)
        assert claim.trial.number == number
        assert claims.settle(claim, Trial(number=number, state="COMPLETE", values=[1.0], runs=()))

    settled(0)
    settled(1)
    held = claims.claim("two", 5, HOUR_S)
    assert [one.is_reported for one in claims.all()] == [False, False, False]
    claims.mark_reported(1)
    settled(3)
    assert [one.is_reported for one in claims.all()] == [False, True, False, False]
    claims.mark_reported(0)
    claims.mark_reported(3)
    claims.renew(held, HOUR_S, {"completion": 1.0})
    seen = claims.all()
    assert [one.trial.state for one in seen] == ["COMPLETE", "COMPLETE", "RUNNING", "COMPLETE"]
    assert seen[2].progress == {"completion": 1.0}
    assert claims.all() == seen == TrialClaims(claims._engine, claims.study).all()
    assert [claim.trial.number for claim in claims._final] == [0, 1]
