"""Each slot has one owner at a time, whoever races, is late, or is killed; on each kind of database."""

import random
import time

from sweeps.ledger import Ledger

THREE = ("anna", "ben", "cleo")
HOUR_S = 3600.0


def _settle_all(ledger: Ledger, total: int) -> None:
    while (claim := ledger.claim("last", total, HOUR_S)) is not None:
        assert ledger.settle(claim, "COMPLETE", [1.0], {})


def test_racing_processes_get_each_slot_exactly_once(url, race):
    lines = race("claim", url, THREE, 24, HOUR_S).lines()
    claimed = [tuple(map(int, line.split()[:2])) for printed in lines for line in printed]
    assert sorted(claimed) == [(slot, 1) for slot in range(24)]


def test_a_lease_that_ran_out_is_taken_over_exactly_once(url, ledger, race):
    for owner in ("first", "second"):
        ledger.note(claim := ledger.claim(owner, 2, HOUR_S), trial_id=40 + claim.slot)
    for owner in ("first", "second"):
        assert ledger.release(owner) == 1
    lines = race("claim", url, THREE, 2, HOUR_S).lines()
    taken = sorted(line for printed in lines for line in printed)
    assert taken == ["0 2 first 40", "1 2 second 41"]


def test_processes_may_make_the_table_together(url, race):
    assert race("table", url, THREE).lines() == [["made"]] * 3


def test_nothing_that_a_late_owner_writes_is_kept(ledger):
    late = ledger.claim("late", 1, 0.0)
    heir = ledger.claim("heir", 1, HOUR_S)
    ledger.note(heir, trial_id=7, runs=[{"seed": 1}])
    before = ledger.slots()
    assert not ledger.renew(late, HOUR_S, {"completion": 100.0})
    assert not ledger.note(late, trial_id=8, runs=[])
    assert not ledger.settle(late, "COMPLETE", [1.0], {"fate": "finished"})
    assert ledger.release("late") == 0
    assert ledger.slots() == before
    assert ledger.settle(heir, "PRUNED", None, {"fate": "collapsed"})
    assert not ledger.settle(late, "COMPLETE", [1.0], {})
    assert ledger.slots()[0].outcome == "PRUNED"


def test_the_heir_knows_what_the_earlier_owner_noted(ledger):
    first = ledger.claim("first", 1, 0.0)
    runs = [{"seed": 1, "run_dir": "runs/ä", "status": "running", "value": None}]
    assert ledger.note(first, trial_id=3)
    assert ledger.note(first, runs=runs)
    heir = ledger.claim("heir", 1, HOUR_S)
    assert (heir.slot, heir.attempt, heir.previous_owner) == (0, 2, "first")
    assert (heir.trial_id, heir.runs) == (3, tuple(runs))


def test_a_lease_that_ran_out_is_renewed_while_nobody_took_it(ledger):
    claim = ledger.claim("slow", 1, 0.0)
    assert ledger.slots()[0].expired
    assert ledger.renew(claim, HOUR_S)
    assert not ledger.slots()[0].expired
    assert ledger.claim("other", 1, HOUR_S) is None


def test_a_lease_runs_out_by_itself_and_not_before(ledger):
    lease_s = 2.0
    began = time.monotonic()
    claim = ledger.claim("slow", 1, lease_s)
    until = time.monotonic() + 60.0
    while (heir := ledger.claim("heir", 1, HOUR_S)) is None:
        assert time.monotonic() < until
        time.sleep(0.05)
    assert time.monotonic() - began > 0.95 * lease_s
    assert (heir.slot, heir.attempt) == (claim.slot, 2)


def test_who_claims_while_it_holds_a_slot_gets_that_slot_again(ledger):
    """The answer to its first claim went with the connection."""
    first = ledger.claim("one", 5, HOUR_S)
    assert ledger.claim("one", 5, HOUR_S) == first
    assert len(ledger.slots()) == 1


def test_a_result_that_is_given_twice_is_held_and_the_first_one_stays(ledger):
    claim = ledger.claim("one", 1, HOUR_S)
    assert ledger.settle(claim, "COMPLETE", [12.5], {"fate": "finished"})
    assert ledger.settle(claim, "FAIL", None, {})
    ledger.mark_told(0)
    assert ledger.settle(claim, "FAIL", None, {})
    assert not ledger.renew(claim, HOUR_S)
    assert not ledger.note(claim, trial_id=1)
    (slot,) = ledger.slots()
    assert (slot.state, slot.outcome, slot.values, slot.attrs) == (
        "told",
        "COMPLETE",
        [12.5],
        {"fate": "finished"},
    )


def test_what_is_released_is_free_at_once_and_only_that(ledger):
    for owner in ("gone", "there"):
        ledger.claim(owner, 2, HOUR_S)
    assert ledger.release("gone") == 1
    assert ledger.release("gone") == 0
    assert [slot.expired for slot in ledger.slots()] == [True, False]
    assert ledger.claim("heir", 2, HOUR_S).previous_owner == "gone"
    assert ledger.claim("other", 2, HOUR_S) is None


def test_a_result_waits_until_optuna_was_told(ledger):
    claim = ledger.claim("one", 2, HOUR_S)
    ledger.settle(claim, "COMPLETE", [1.0, 2.0], {"reason": "x" * 70_000})
    assert [(slot.slot, slot.values) for slot in ledger.settled()] == [(0, [1.0, 2.0])]
    assert len(ledger.settled()[0].attrs["reason"]) == 70_000
    ledger.mark_told(0)
    ledger.mark_told(0)
    assert ledger.settled() == []
    assert ledger.is_done(1)
    assert not ledger.is_done(2)


def test_a_finished_slot_is_never_given_again_and_the_total_may_change(ledger):
    _settle_all(ledger, 3)
    assert ledger.claim("late", 3, HOUR_S) is None
    assert ledger.claim("late", 5, 0.0).slot == 3
    assert ledger.claim("next", 3, HOUR_S) is None, "beyond the total nothing is taken over"
    _settle_all(ledger, 5)
    assert [slot.slot for slot in ledger.slots()] == [0, 1, 2, 3, 4]


def test_studies_of_one_database_share_no_slot(engine, ledger):
    other = Ledger(engine, "other")
    mine, its = ledger.claim("one", 1, HOUR_S), other.claim("one", 1, HOUR_S)
    assert (mine.slot, its.slot) == (0, 0)
    assert other.settle(its, "FAIL", None, {})
    assert not ledger.is_done(1)
    assert ledger.renew(mine, HOUR_S)


def test_progress_stays_until_it_is_told_anew(ledger):
    claim = ledger.claim("one", 1, HOUR_S)
    assert ledger.renew(claim, HOUR_S, {"completion": 12.5})
    assert ledger.renew(claim, HOUR_S)
    assert ledger.slots()[0].progress == {"completion": 12.5}


def test_kills_in_the_middle_of_claiming_lose_no_slot_and_double_none(url, ledger, race):
    total = 20
    racers = race("claim", url, THREE, total, HOUR_S)
    for number in (0, 1):
        time.sleep(random.uniform(0.0, 0.05))
        racers[number].kill()
    printed = {int(line.split()[0]) for lines in racers.lines() for line in lines if line.count(" ") == 3}
    slots = ledger.slots()
    assert [slot.slot for slot in slots] == list(range(total)), "the one that lives has claimed the rest"
    assert printed <= {slot.slot for slot in slots}
    for slot in slots:
        assert ledger.release(slot.owner) == 1
    _settle_all(ledger, total)
    assert [(slot.slot, slot.attempt, slot.state) for slot in ledger.slots()] == [
        (slot, 2, "settled") for slot in range(total)
    ]
