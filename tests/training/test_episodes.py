import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.deepracer.trace import PACKED, STATUS_CODE
from deepracer_exp.training.metrics import EpisodeBook


class Driven:
    """Rows of cars that drive episodes of given lengths, one after the other."""

    def __init__(self, lengths: list[list[int]], tracks: list[int] | None = None):
        self.tracks = tracks or [0] * len(lengths)
        self.cars = [[(step, step == n) for n in car for step in range(1, n + 1)] for car in lengths]
        self.at = [0] * len(lengths)

    def rows(self, car: int, steps: int) -> np.ndarray:
        trace = np.zeros((steps, len(PACKED)))
        for row in trace:
            step, done = self.cars[car][self.at[car]]
            self.at[car] += 1
            row[[PACKED["car"], PACKED["steps"], PACKED["done"]]] = car, step, done
            row[PACKED["track"]] = self.tracks[car]
            row[PACKED["episode_return"]] = 10 * car + step
            row[PACKED["episode_status"]] = STATUS_CODE["lap_complete" if done else "in_progress"]
        return trace

    def batch(self, steps: int, cars: list[int] | None = None) -> np.ndarray:
        return np.stack([self.rows(car, steps) for car in (range(len(self.cars)) if cars is None else cars)])


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
    driven, book = Driven(lengths), EpisodeBook(len(lengths), 1, remembered=5, step_s=1 / 15)
    rows = [book.enter(driven.batch(steps))[0] for steps in batches]
    _check(rows)
    assert book.all.finished == sum(int(part[:, PACKED["done"]].sum()) for part in rows)
    for part in rows:
        keys = part[:, [PACKED["episode"], PACKED["steps"]]]
        assert np.array_equal(keys, keys[np.lexsort((keys[:, 1], keys[:, 0]))])


@given(st.lists(st.lists(st.integers(0, 2), min_size=1, max_size=4), min_size=1, max_size=5))
def test_a_process_that_delivers_twice_in_one_iteration_keeps_its_episodes_apart(deliveries):
    """Asynchronous collection: cars 0 and 1, 2 and 3, 4 and 5 belong together; one of them may be faster."""
    driven, book = Driven([[3, 1, 4, 2, 5] * 20] * 6), EpisodeBook(6, 1, remembered=5, step_s=1 / 15)
    rows = []
    for iteration in deliveries:
        parts = [driven.batch(4, [2 * process, 2 * process + 1]) for process in iteration]
        rows.append(book.enter(np.concatenate(parts))[0])
    _check(rows)


def test_episodes_that_begin_together_are_numbered_by_car_and_earlier_ones_first():
    driven, book = Driven([[2, 9], [3, 9], [9]]), EpisodeBook(3, 1, remembered=5, step_s=1 / 15)
    rows, _ = book.enter(driven.batch(4))
    first = rows[rows[:, PACKED["steps"]] == 1]
    assert first[:, PACKED["car"]].tolist() == [0, 1, 2, 0, 1]


def test_finished_episodes_come_in_the_order_of_their_ends():
    driven, book = Driven([[3, 9], [2, 9], [4, 9]]), EpisodeBook(3, 1, remembered=5, step_s=1 / 15)
    _, finished = book.enter(driven.batch(4))
    assert finished.returns.tolist() == [12, 3, 24]
    assert finished.lap.all()
    # The prepare step is no driving.
    assert finished.time_s == pytest.approx([1 / 15, 2 / 15, 3 / 15])
    assert book.all.best_lap_s == pytest.approx(1 / 15)


def test_the_share_of_laps_is_known_only_once_enough_episodes_have_ended():
    driven, book = Driven([[2] * 20]), EpisodeBook(1, 1, remembered=3, step_s=1 / 15)
    book.enter(driven.batch(5))
    assert book.all.lap_share is None
    book.enter(driven.batch(1))
    assert book.all.lap_share == 1.0
    assert book.all.laps == book.all.finished == 3


def test_every_track_has_a_record_of_its_own_and_together_they_are_all():
    driven = Driven([[2] * 20, [3] * 20, [5] * 20, [9] * 20], tracks=[1, 0, 1, 2])
    book = EpisodeBook(4, 4, remembered=3, step_s=1.0)
    _, finished = book.enter(driven.batch(6))
    assert finished.track.tolist() == [1, 0, 1, 1, 1, 0]
    assert finished.on(0).returns.tolist() == [13, 13]
    assert [record.finished for record in book.tracks] == [2, 4, 0, 0]
    assert [record.best_lap_s for record in book.tracks] == [2.0, 1.0, None, None]
    assert [record.lap_share for record in book.tracks] == [None, 1.0, None, None]
    assert book.all.finished == 6


def test_the_batch_given_is_left_as_it_was():
    trace = Driven([[2, 5]]).batch(4)
    before = trace.copy()
    EpisodeBook(1, 1, remembered=3, step_s=1 / 15).enter(trace)
    np.testing.assert_array_equal(trace, before)
