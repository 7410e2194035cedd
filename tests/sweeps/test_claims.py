"""Each trial has one owner at a time, whether workers race, are late or are killed; on each kind of database."""

import random
import time

from deepracer_exp.sweeps.queue.claims import TrialClaims
from deepracer_exp.sweeps.trial import SeedRun, Trial
from tests.waiting import wait_until

from .racer import claim_all

THREE = ("anna", "ben", "cleo")
HOUR_S = 3600.0


def result(state="COMPLETE", values=None, number=0, **run) -> Trial:
    return Trial(number=number, state=state, values=values, runs=(SeedRun(seed=0, values=values, **run),))


def _settle_all(claims: TrialClaims, total: int) -> None:
    while (claim := claims.claim("last", total, HOUR_S)) is not None:
        assert claims.settle(claim, result(values=[1.0]))


def test_racing_processes_get_each_trial_once_and_take_over_each_expired_lease_once(url, claims, race):
    for owner in ("first", "second"):
        claims.record(claims.claim(owner, 24, HOUR_S), [SeedRun(seed=0)])
    for owner in ("first", "second"):
        assert claims.release(owner) == 1
    lines = race(claim_all, url, THREE, 24, HOUR_S).lines()
    claimed = {line for printed in lines for line in printed}
    assert claimed == {"0 2 1", "1 2 1", *(f"{number} 1 0" for number in range(2, 24))}
    assert sum(map(len, lines)) == 24


def test_the_next_owner_gets_what_a_late_one_recorded_and_no_later_write_of_that_is_kept(claims):
    late = claims.claim("late", 1, 0.0)
    runs = (SeedRun(seed=1, run_dir="runs/ä"),)
    assert claims.record(late, runs)
    heir = claims.claim("heir", 1, HOUR_S)
    assert (heir.attempt, heir.trial) == (2, Trial(number=0, runs=runs))
    claims.record(heir, [SeedRun(seed=1)])
    before = claims.all()
    assert not claims.renew(late, HOUR_S, {"completion": 100.0})
    assert not claims.record(late, [])
    assert not claims.settle(late, result(values=[1.0], ending="finished"))
    assert claims.release("late") == 0
    assert claims.all() == before
    assert claims.settle(heir, result("PRUNED", ending="collapsed"))
    assert not claims.settle(late, result(values=[1.0]))
    assert claims.all()[0].trial.state == "PRUNED"


def test_a_lease_expires_by_itself_and_not_before(claims):
    lease_s = 0.6
    late = claims.claim("late", 1, 0.0)
    assert claims.all()[0].expired
    assert claims.renew(late, HOUR_S, {"completion": 12.5}), "until another worker takes it over"
    assert claims.claim("other", 1, HOUR_S) is None
    began = time.monotonic()
    assert claims.renew(late, lease_s)
    claim = claims.all()[0]
    assert claim.progress == {"completion": 12.5}
    heir = wait_until(lambda: claims.claim("heir", 1, HOUR_S), "claim")
    assert time.monotonic() - began > 0.95 * lease_s
    assert (heir.trial.number, heir.attempt) == (claim.trial.number, 2)


def test_an_owner_that_claims_again_gets_its_trial_again(claims):
    """The answer to its first claim was lost with the connection."""
    first = claims.claim("one", 5, HOUR_S)
    assert claims.claim("one", 5, HOUR_S) == first
    assert len(claims.all()) == 1


def test_a_lease_that_was_renewed_while_another_looked_is_not_taken_over(claims, monkeypatch):
    late, look = claims.claim("late", 1, 0.0), claims._open_to

    def renewed_meanwhile(*arguments: object):
        found = look(*arguments)
        assert claims.renew(late, HOUR_S)
        return found

    monkeypatch.setattr(claims, "_open_to", renewed_meanwhile)
    assert claims.claim("other", 1, HOUR_S) is None
    assert claims.renew(late, HOUR_S)


def test_an_owner_that_took_its_own_trial_over_writes_by_its_newer_claim_alone(claims):
    older, newer = claims.claim("one", 1, 0.0), claims.claim("one", 1, HOUR_S)
    assert (older.attempt, newer.attempt) == (1, 2)
    before = claims.all()
    assert not claims.record(older, [SeedRun(seed=0)])
    assert not claims.settle(older, result(values=[1.0]))
    assert claims.all() == before
    assert claims.settle(newer, result("FAIL"))


def test_a_second_result_is_accepted_and_the_first_one_stays(claims):
    claim = claims.claim("one", 1, HOUR_S)
    first = result(values=[12.5], ending="finished")
    assert claims.settle(claim, first)
    assert claims.settle(claim, result("FAIL"))
    claims.mark_reported(0)
    assert claims.settle(claim, result("FAIL"))
    assert not claims.renew(claim, HOUR_S)
    assert not claims.record(claim, [])
    (stored,) = claims.all()
    assert (stored.is_reported, stored.trial) == (True, first)


def test_a_release_frees_the_trials_of_that_owner_only(claims):
    for owner in ("gone", "there"):
        claims.claim(owner, 2, HOUR_S)
    assert claims.release("gone") == 1
    assert claims.release("gone") == 0
    assert [one.expired for one in claims.all()] == [True, False]
    assert claims.claim("heir", 2, HOUR_S).trial.number == 0
    assert claims.claim("other", 2, HOUR_S) is None


def test_attempts_stay_counted_where_a_worker_was_lost_and_not_where_it_was_to_end(claims):
    for is_lost, tries in ((True, 2), (False, 0), (True, 0)):
        claim = claims.claim("gone", 1, HOUR_S)
        if is_lost and tries:
            claims.record(claim, [SeedRun(seed=0, tries=2)])
        assert claims.release("gone", is_lost=is_lost) == 1
        (found,) = claims.all()
        assert [run.tries for run in found.trial.runs] == [tries]


def test_a_result_waits_until_it_is_reported_to_optuna(claims):
    claim = claims.claim("one", 2, HOUR_S)
    claims.settle(claim, result(values=[1.0, 2.0], reason="x" * 70_000))
    (waiting,) = claims.unreported()
    assert (waiting.trial.number, waiting.trial.values) == (0, [1.0, 2.0])
    assert len(waiting.trial.reason) == 70_000
    claims.mark_reported(0)
    claims.mark_reported(0)
    assert claims.unreported() == []
    assert claims.is_done(1)
    assert not claims.is_done(2)


def test_a_finished_trial_is_never_claimed_again_and_the_total_may_change(claims):
    _settle_all(claims, 3)
    assert claims.claim("late", 3, HOUR_S) is None
    assert claims.claim("late", 5, 0.0).trial.number == 3
    assert claims.claim("next", 3, HOUR_S) is None, "beyond the total nothing is taken over"
    _settle_all(claims, 5)
    assert [one.trial.number for one in claims.all()] == [0, 1, 2, 3, 4]


def test_studies_of_one_database_share_no_claim(engine, claims):
    other = TrialClaims(engine, "other")
    mine, its = claims.claim("one", 1, HOUR_S), other.claim("one", 1, HOUR_S)
    assert (mine.trial.number, its.trial.number) == (0, 0)
    assert other.settle(its, result("FAIL"))
    assert not claims.is_done(1)
    assert claims.renew(mine, HOUR_S)


def test_kills_in_the_middle_of_claiming_lose_and_double_no_trial(url, claims, race, tmp_path):
    total = 20
    racers = race(claim_all, url, THREE, total, HOUR_S)
    for number in (0, 1):
        # Past the barrier: a process that is killed in it could leave its lock closed for the others.
        wait_until((tmp_path / THREE[number]).exists)
        time.sleep(random.uniform(0.0, 0.05))
        racers[number].kill()
    printed = {int(line.split()[0]) for lines in racers.lines() for line in lines if line.count(" ") == 2}
    found = claims.all()
    assert [one.trial.number for one in found] == list(range(total)), (
        "the one that lives has claimed the rest"
    )
    assert printed <= set(range(total))
    for one in found:
        assert claims.release(one.owner) == 1
    _settle_all(claims, total)
    assert [(one.trial.number, one.attempt) for one in claims.unreported()] == [
        (number, 2) for number in range(total)
    ]
