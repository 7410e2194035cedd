"""Episodes counted from the trace, and the figures and ranks that follow from them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.stopping import NoStopping, ReliableStopping
from deepracer_exp.env.setup import build_setup
from deepracer_exp.env.trace_columns import PACKED, STATUS_CODE
from deepracer_exp.training.best_policy import BestPolicy
from deepracer_exp.training.metrics import Finished, Ranking, RunMetrics
from deepracer_exp.training.stopping.stopping_rules import build_rule


class Driven:
    """Rows of cars that drive episodes of given lengths, one after the other."""

    def __init__(self, lengths: list[list[int]]):
        self.cars = [[(step, step == n) for n in car for step in range(1, n + 1)] for car in lengths]
        self.at = [0] * len(lengths)

    def rows(self, car: int, steps: int) -> np.ndarray:
        trace = np.zeros((steps, len(PACKED)))
        for row in trace:
            step, done = self.cars[car][self.at[car]]
            self.at[car] += 1
            row[[PACKED["car"], PACKED["steps"], PACKED["done"]]] = car, step, done
            row[PACKED["episode_return"]] = 10 * car + step
            row[PACKED["episode_status"]] = STATUS_CODE["lap_complete" if done else "in_progress"]
        return trace

    def batch(self, steps: int, cars: list[int] | None = None) -> np.ndarray:
        return np.stack([self.rows(car, steps) for car in (range(len(self.cars)) if cars is None else cars)])


def book_of(n_cars: int, remembered: int = 5) -> RunMetrics:
    rule = ReliableStopping(kind="reliable", lap_share=0.75, episodes=remembered)
    return RunMetrics(["Oval_track"], n_cars, 1 / 15, rule)


def _check(rows: list[np.ndarray]) -> None:
    """Every car's steps count up within an episode and every episode has one car."""
    table = np.concatenate(rows)
    episodes = table[:, PACKED["episode"]]
    assert np.array_equal(np.unique(episodes), np.arange(episodes.max() + 1))
    for number in np.unique(episodes):
        episode = table[episodes == number]
        assert len(set(episode[:, PACKED["car"]])) == 1
        assert np.array_equal(np.sort(episode[:, PACKED["steps"]]), np.arange(1, len(episode) + 1))


lengths = st.lists(st.lists(st.integers(1, 9), min_size=40, max_size=40), min_size=1, max_size=5)


@given(lengths, st.lists(st.integers(1, 7), min_size=1, max_size=5))
def test_episodes_are_numbered_without_gaps_over_batches_of_any_length(lengths, batches):
    driven, book = Driven(lengths), book_of(len(lengths))
    given = [driven.batch(steps) for steps in batches]
    before = [batch.copy() for batch in given]
    rows = [book.enter(batch)[0] for batch in given]
    np.testing.assert_array_equal(np.concatenate(given, axis=1), np.concatenate(before, axis=1))
    _check(rows)
    assert book.all.finished == sum(int(part[:, PACKED["done"]].sum()) for part in rows)
    for part in rows:
        keys = part[:, [PACKED["episode"], PACKED["steps"]]]
        assert np.array_equal(keys, keys[np.lexsort((keys[:, 1], keys[:, 0]))])


def test_finished_episodes_come_in_the_order_of_their_ends():
    driven, book = Driven([[3, 9], [2, 9], [4, 9]]), book_of(3)
    _, finished = book.enter(driven.batch(4))
    assert finished.returns.tolist() == [12, 3, 24]
    assert finished.lap.all()
    assert finished.time_s == pytest.approx([2 / 15, 3 / 15, 4 / 15])
    assert book.all.best_lap_s == pytest.approx(2 / 15)


def test_the_fastest_lap_is_none_of_a_car_that_differs():
    for usual, fastest in (([True, False, True, False], 4), ([True] * 4, 1), (None, 1)):
        on_usual = None if usual is None else np.array(usual)
        book = RunMetrics(["Oval_track"], 4, 1 / 15, RULE, on_usual)
        book.enter(Driven([[9], [1] * 9, [4, 9], [2, 9]]).batch(9))
        assert book.all.best_lap_s == pytest.approx(fastest / 15)
        assert book.all.laps == 12


def test_the_share_of_laps_is_known_only_once_enough_episodes_have_ended():
    driven, book = Driven([[2] * 20]), book_of(1, remembered=3)
    book.enter(driven.batch(5))
    assert book.all.lap_share is None
    book.enter(driven.batch(1))
    assert book.all.lap_share == 1.0
    assert book.all.laps == book.all.finished == 3


RULE = ReliableStopping(kind="reliable", lap_share=0.75, episodes=4)


def drive(results: RunMetrics, track: int, laps: int, others: int = 0, steps: int = 30):
    """End as many complete laps and other episodes on a track, one car each."""
    trace = np.zeros((laps + others, 1, len(PACKED)))
    row = trace[:, 0]
    row[:, PACKED["car"]] = np.arange(len(row))
    row[:, [PACKED["track"], PACKED["steps"], PACKED["done"]]] = track, steps, 1
    is_lap = np.arange(len(row)) < laps
    row[:, PACKED["progress"]] = np.where(is_lap, 100, 40)
    status = np.where(is_lap, STATUS_CODE["lap_complete"], STATUS_CODE["off_track"])
    row[:, PACKED["episode_status"]] = status
    return results.enter(trace)[1]


def test_one_track_has_no_metrics_of_its_own():
    results = RunMetrics(["Oval_track"], 8, 1 / 15, RULE)
    finished = drive(results, 0, laps=3, others=1)
    assert results.row_of_tracks(finished) == {}
    figures = ("mean_return", "completion", "lap_share", "best_lap_time_s", "mean_lap_time_s")
    assert tuple(results.row(finished)) == figures
    assert results.row(finished)["best_lap_time_s"] == pytest.approx(2.0)
    assert results.summary() == {"lap_share": 0.75, "best_lap_time_s": pytest.approx(2.0)}


def test_every_track_has_its_own_figures_and_the_whole_no_lap_time():
    results = RunMetrics(["a", "b", "c"], 8, 1 / 15, RULE)
    drive(results, 0, laps=4)
    finished = drive(results, 1, laps=1, others=3, steps=45)
    whole, each = results.row(finished), results.row_of_tracks(finished)
    assert (whole["completion"], whole["best_lap_time_s"], whole["mean_lap_time_s"]) == (55.0, None, None)
    assert whole["lap_share"] is None
    assert results.row(drive(results, 2, laps=4))["lap_share"] == 0.25, "that of the track where it is lowest"
    figures = {"completion": 55.0, "lap_share": 0.25, "best_lap_time_s": 3.0, "mean_lap_time_s": 3.0}
    of_each = {
        "a": figures
        | {"completion": None, "lap_share": 1.0, "best_lap_time_s": 2.0, "mean_lap_time_s": None},
        "b": figures,
        "c": dict.fromkeys(figures),
    }
    assert each == pytest.approx({f"{key}/{name}": row[key] for name, row in of_each.items() for key in row})


def test_the_summary_has_each_track_by_its_name_with_what_was_known_last():
    results = RunMetrics(["Kurs ß", "b"], 8, 1 / 15, NoStopping(kind="none"))
    results.row_of_tracks(drive(results, 0, laps=1, others=1))
    results.row_of_tracks(drive(results, 1, laps=2, steps=15))
    summary = results.summary()
    assert summary["best_lap_time_s"] is None
    assert summary["tracks"]["Kurs ß"] == {
        **{"episodes": 2, "laps": 1, "completion": 70.0, "lap_share": None},
        **{"best_lap_time_s": pytest.approx(2.0), "mean_lap_time_s": pytest.approx(2.0)},
    }
    assert summary["tracks"]["b"]["laps"] == 2


def reliable(results: RunMetrics) -> str | None:
    """Return what the stopping rule says of the results."""
    shares = {f"lap_share/{label}": None for label in results.labels}
    decision = build_rule(RULE, 5).observe({"lap_share": results.lap_share, **shares})
    return decision and decision.why


def test_reliable_is_what_is_reliable_on_every_track():
    results = RunMetrics(["a", "b"], 8, 1 / 15, RULE)
    drive(results, 0, laps=8)
    assert reliable(results) is None  # nothing is known of the other
    drive(results, 1, laps=2, others=2)
    assert reliable(results) is None
    drive(results, 1, laps=2)
    assert reliable(results) is None  # two of the last four
    drive(results, 1, laps=1)
    assert reliable(results) == "75% or more of the last 4 episodes completed the lap on each of 2 tracks"
    drive(results, 0, laps=0, others=2)
    assert reliable(results) is None


def ended(*episodes: tuple[int, float, float]) -> Finished:
    """Episodes as (track, progress, seconds); those of 100 per cent are laps."""
    track, progress, time_s = np.array(episodes, float).reshape(-1, 3).T
    usual = np.ones(len(track), bool)
    return Finished(track.astype(int), np.zeros(len(track)), progress, progress == 100, time_s, usual)


def test_completion_counts_before_speed_and_a_faster_lap_before_a_slower_one():
    def rank(*episodes: tuple[int, float, float]) -> tuple[float, float]:
        found = Ranking([20.0]).rank(ended(*episodes))
        assert found is not None
        return found

    no_lap = rank(*[(0, 90.0, 1.0)] * 10)
    slow, fast = rank(*[(0, 100.0, 20.0)] * 10), rank(*[(0, 100.0, 10.0)] * 10)
    mixed = rank(*[(0, 100.0, 5.0)] * 9, (0, 10.0, 1.0))
    assert no_lap < mixed < slow < fast
    assert fast == (100.0, 2.0)
    assert no_lap == (90.0, 0.0)


def test_few_episodes_are_not_ranked_and_each_track_counts_the_same_however_many_it_has():
    assert Ranking([20.0]).rank(ended(*[(0, 100.0, 10.0)] * 9)) is None
    assert Ranking([20.0]).rank(ended()) is None
    rank = Ranking([10.0, 40.0]).rank(ended(*[(0, 20.0, 1.0)] * 30, (1, 100.0, 10.0)))
    assert rank == (60.0, 2.0)


def test_a_track_counts_with_the_last_iteration_that_ended_an_episode_on_it():
    ranking = Ranking([10.0, 10.0])
    assert ranking.rank(ended(*[(0, 50.0, 1.0)] * 20)) is None
    assert ranking.rank(ended((1, 100.0, 5.0))) == (75.0, 1.0)
    assert ranking.rank(ended(*[(0, 100.0, 5.0)] * 12)) == (100.0, 2.0)
    assert ranking.rank(ended()) is None
    assert ranking.rank(ended((1, 40.0, 5.0))) == (70.0, 1.0)


def test_a_resumed_run_ranks_its_policies_as_if_it_had_never_been_interrupted():
    experiment, _ = compose_experiment(["experiment=tiny", "checkpoints.every=null"])
    setup = build_setup(compose_experiment(["experiment=tiny", "track=[reinvent_base,Oval_track]"])[0])
    before, after = BestPolicy(experiment, setup), BestPolicy(experiment, setup)
    assert not before.drove_best(ended(*[(0, 50.0, 1.0)] * 20), {"iteration": 1, "env_steps": 100})
    after.load_state_dict(before.state_dict())
    for policy in (before, after):
        assert policy.drove_best(ended((1, 100.0, 5.0)), {"iteration": 2, "env_steps": 200})
    assert after.record == before.record
