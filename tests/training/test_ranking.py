import numpy as np

from deepracer_exp.training.metrics import Finished, Ranking


def ended(*episodes: tuple[int, float, float]) -> Finished:
    """Episodes as (track, progress, seconds); those of 100 per cent are laps."""
    track, progress, time_s = np.array(episodes, float).reshape(-1, 3).T
    return Finished(track.astype(int), np.zeros(len(track)), progress, progress == 100, time_s)


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


def test_few_episodes_are_not_ranked():
    assert Ranking([20.0]).rank(ended(*[(0, 100.0, 10.0)] * 9)) is None
    assert Ranking([20.0]).rank(ended()) is None


def test_each_track_counts_the_same_however_many_episodes_it_has():
    rank = Ranking([10.0, 40.0]).rank(ended(*[(0, 20.0, 1.0)] * 30, (1, 100.0, 10.0)))
    assert rank == (60.0, 2.0)


def test_a_track_counts_with_the_last_iteration_that_ended_an_episode_on_it():
    ranking = Ranking([10.0, 10.0])
    assert ranking.rank(ended(*[(0, 50.0, 1.0)] * 20)) is None
    assert ranking.rank(ended((1, 100.0, 5.0))) == (75.0, 1.0)
    assert ranking.rank(ended(*[(0, 100.0, 5.0)] * 12)) == (100.0, 2.0)
    assert ranking.rank(ended()) is None
    assert ranking.rank(ended((1, 40.0, 5.0))) == (70.0, 1.0)
