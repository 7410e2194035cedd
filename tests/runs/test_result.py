"""What is said of a run's policies names whose laps are meant, under which conditions."""

from dataclasses import asdict

import pytest

from deepracer_exp.runs.run_result import Ending, fastest_reliable, result_of, why_not_fastest


@pytest.mark.parametrize(
    ("ending", "words"),
    [
        (Ending.by_rule("not_learning", "no lap", "stopped early"), "stopped early: not learning: no lap"),
        (Ending.by_budget("minutes"), "finished: budget reached: minutes"),
        (Ending("interrupted", "by Ctrl-C"), "interrupted: by Ctrl-C"),
    ],
)
def test_an_ending_is_read_back_from_a_summary_as_it_was(ending, words):
    assert Ending.stored({**asdict(ending), "iteration": 4}) == ending
    assert str(ending) == words


def test_an_ending_is_read_from_a_summary_that_names_neither_rule_nor_limit():
    summary = {"status": "finished", "reason": "reliable: 94% of the last 50 episodes completed the lap"}
    assert Ending.stored(summary) == Ending(**summary)
    assert Ending.stored({}) is None


def row(iteration: int, lap_s: float | None, laps: int, tried: int = 8) -> dict:
    return {
        "iteration": iteration,
        "eval_lap_time_s": lap_s,
        "eval_lap_share": laps / tried,
        "eval_laps": laps,
        "eval_laps_tried": tried,
    }


def test_the_fastest_reliable_lap_is_that_of_a_policy_that_completes_nineteen_of_twenty():
    rows = [
        row(10, 5.0, 7),
        {"iteration": 11},
        row(20, None, 0),
        row(30, 7.0, 8),
        row(40, 6.72, 8),
        row(50, 6.9, 8),
    ]
    assert str(fastest_reliable(rows)) == "checkpoint 40, 6.72 s, 8 of 8"
    assert str(fastest_reliable([row(10, 5.0, 19, 20)])) == "checkpoint 10, 5.00 s, 19 of 20"
    assert fastest_reliable(rows[:3]) is None


def test_a_lap_time_without_a_share_of_laps_is_no_reliable_lap():
    assert fastest_reliable([{"iteration": 40, "eval_lap_time_s": 6.72}]) is None


BEST = {"iteration": 40, "metric": "race_score", "rank": [1.0, -8.0], "eval_race_score_s": 8.02}
BEST |= {"eval_completion": 100.0, "eval_lap_time_s": 7.97, "eval_lap_share": 1.0}


@pytest.mark.parametrize(
    ("summary", "words"),
    [
        (
            {"best": BEST | {"held_out_completion": 84.7}},
            "mean usual lap 7.97 s, usual laps complete 100%, held-out completion 85%, "
            "race score (usual and held-out) 8.02 s",
        ),
        (
            {"best": BEST},
            "mean usual lap 7.97 s, usual laps complete 100%, race score (usual) 8.02 s",
        ),
        (
            {"best": BEST | {"eval_lap_share": 0.875, "eval_completion": 96.25}},
            "mean usual lap 7.97 s, usual laps complete 88%, usual completion 96%, race score (usual) 8.02 s",
        ),
        (
            {"lap_share": 0.5, "best_lap_time_s": 12.0, "last": {"completion": 61.0}},
            "exploring completion 61%, fastest exploring lap 12.00 s",
        ),
    ],
)
def test_figures_name_conditions_and_exploration(summary, words):
    assert result_of(summary).words() == words


def test_why_another_checkpoint_than_the_fastest_is_the_best_is_said():
    def evaluated(iteration: int, lap_s: float, score_s: float | None) -> dict:
        laps = {"eval_lap_share": 1.0, "eval_laps": 8, "eval_laps_tried": 8, "eval_lap_time_s": lap_s}
        return {"iteration": iteration, "eval_race_score_s": score_s, **laps}

    def why(rows: list[dict], metric: str = "race_score") -> str | None:
        best = {"iteration": 40, "metric": metric, "rank": [1.0, -5.6], "eval_completion": 100.0}
        best |= {"eval_lap_time_s": 5.37, "eval_race_score_s": 5.6, "held_out_completion": 90.0}
        return why_not_fastest(result_of({"best": best}), rows)

    best = evaluated(40, 5.37, 5.6)
    assert why([evaluated(30, 5.4, 5.7), best]) is None
    assert why([evaluated(30, 5.23, 6.02), best]) == (
        "checkpoint 30 laps faster, but its race score (usual and held-out) is 6.02 s"
    )
    assert why([evaluated(30, 5.23, None), best]) == (
        "checkpoint 30 laps faster, but it has no race score (usual and held-out)"
    )
    assert why([evaluated(30, 5.23, 6.02), best], "progress") == (
        "checkpoint 40 ranks above checkpoint 30, which laps faster, by completion (usual and held-out)"
    )
