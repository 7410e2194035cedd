"""Leases, which each worker renews for its own trial."""

import pytest
import sqlalchemy as sa

from deepracer_exp.sweeps.queue.claims import TrialClaims
from deepracer_exp.sweeps.queue.lease import Lease
from deepracer_exp.sweeps.trial import Trial
from deepracer_exp.training.train_result import TakenOver
from tests.waiting import wait_until

HOUR_S = 3600.0


@pytest.fixture
def statements(engine):
    """Every statement that the database is sent."""
    sent = []
    sa.event.listen(engine, "after_cursor_execute", lambda *what: sent.append(what[2]))
    return sent


def test_a_worker_renews_its_lease_and_says_how_far_it_is(claims):
    claim = claims.claim("one", 1, 3.0)
    with Lease(claims, claim, 3.0, HOUR_S) as lease:
        for iteration in (1, 2):
            lease.progress = {"iteration": iteration}
            wait_until(lambda: claims.all()[0].progress == lease.progress, "renewal")
        lease.confirm()


def test_a_worker_whose_trial_was_taken_over_finds_out(claims):
    late = claims.claim("late", 1, 0.0)
    assert claims.claim("heir", 1, HOUR_S).attempt == 2

    def is_lost() -> bool:
        try:
            lease.confirm()
        except TakenOver:
            return True
        return False

    with Lease(claims, late, 1.0, HOUR_S) as lease:
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
