import functools
import json
import math
from collections.abc import Sequence

import numpy as np
import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.stopping import StoppingConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.training.stopping.stopping_rules import Decision, build_rule, entropy_share

ACTIONS = 15
LONG = 400
"""Iterations of a history."""


@functools.cache
def rule(*overrides: str, option: str = "entropy") -> StoppingConfig:
    return compose_experiment([f"stopping={option}", *overrides])[0].stopping


def stopped_at(
    rows: Sequence[dict], config: StoppingConfig, actions: int | None = ACTIONS
) -> tuple[int, Decision] | tuple[None, None]:
    stopping = build_rule(config, actions)
    for number, row in enumerate(rows, 1):
        decision = stopping.observe(row)
        if decision is not None:
            return number, decision
    return None, None


def history(
    length: int = LONG,
    *,
    completion=50.0,
    entropy=0.5,
    mean_return=10.0,
    laps_per_iteration=5.0,
    lap_share=None,
    held_out=None,
    race_score_s=None,
    lap_time_s=None,
    evaluated_lap_share=1.0,
    noise: float = 0.0,
    seed: int = 0,
) -> list[dict]:
    """Rows of metrics.jsonl; each value a number or a function of the iteration, entropy as a share of chance."""
    random = np.random.default_rng(seed)

    def at(value, iteration: int) -> float | None:
        return value(iteration) if callable(value) else value

    rows, laps = [], 0.0
    for iteration in range(1, length + 1):
        laps += at(laps_per_iteration, iteration)
        row = {
            "env_steps": 8192 * iteration,
            "laps": round(laps),
            "completion": min(100.0, at(completion, iteration) + noise * random.normal()),
            "mean_return": at(mean_return, iteration) * (1 + 0.01 * noise * random.normal()),
            "entropy": at(entropy, iteration) * math.log(ACTIONS),
            "lap_share": at(lap_share, iteration),
        }
        if iteration % 5 == 0:
            evaluated = {"held_out_completion": held_out, "eval_race_score_s": race_score_s}
            evaluated |= {"eval_lap_time_s": lap_time_s, "eval_lap_share": evaluated_lap_share}
            row |= {name: at(value, iteration) for name, value in evaluated.items() if value is not None}
        rows.append(row)
    return rows


def learned(until: int):
    """Rises from 10 to 98 until an iteration, and stays."""
    return lambda iteration: 10 + 88 * min(1.0, iteration / until)


def converging(until: int, **more) -> list[dict]:
    driven = {"completion": learned(until), "mean_return": learned(until)}
    driven["laps_per_iteration"] = lambda i: 20 * min(1.0, i / until)
    driven["entropy"] = lambda i: 1 - 0.7 * min(1.0, i / until)
    return history(**driven | more)


def falling(iterations: int = LONG, **more) -> list[dict]:
    """Held-out completion rises to 90 and falls to 50, as the return rises on."""
    held_out = {"held_out": lambda i: 90 * i / 50 if i <= 50 else max(50.0, 140 - i)}
    grows = {"completion": learned(LONG), "mean_return": learned(LONG)}
    return history(iterations, **grows | held_out | more)


def slowing(**more) -> list[dict]:
    """Evaluated laps fall from 8 to 6 s and rise to 7 s, as the return rises on."""
    lap_time_s = {"lap_time_s": lambda i: 8 - 2 * i / 60 if i <= 60 else min(7.0, 6 + (i - 60) / 100)}
    grows = {name: learned(LONG) for name in ("completion", "mean_return", "held_out")}
    return history(**grows | lap_time_s | more)


RANDOM = {"completion": 11.0, "entropy": 0.999, "laps_per_iteration": 0.0}


def assert_reported(decision: Decision) -> None:
    """It names its rule, and holds values and thresholds as JSON and as tags."""
    stored = json.loads(json.dumps(decision.as_dict()))
    assert stored["rule"] in str(decision).replace(" ", "_")
    assert stored["values"]
    assert stored["thresholds"]["patience"] > 0
    assert all(math.isfinite(value) for value in stored["values"].values())
    tags = decision.tags()
    assert tags["stopping.rule"] == decision.rule
    assert {f"stopping.threshold.{key}" for key in decision.thresholds} <= tags.keys()


@pytest.mark.parametrize(
    ("name", "rows", "at", "within"),
    [
        *(("converged", converging(until, noise=n), until + 80, 10) for until in (30, 120) for n in (0, 0.5)),
        ("not_learning", history(**RANDOM), 42, 3),
        ("collapsed", history(completion=20.0, entropy=lambda i: max(0.01, 1 - 0.1 * i)), 31, 3),
        ("overfitting", falling(), 110, 19),
        ("overfitting", falling(lap_time_s=lambda i: 9 - i / LONG), 110, 19),
        ("laps_slower", slowing(), 165, 15),
    ],
)
def test_each_rule_ends_the_run_that_it_is_for(name, rows, at, within):
    number, decision = stopped_at(rows, rule())
    assert decision.rule == name
    assert decision.stopped_early == (name in ("not_learning", "collapsed"))
    assert number == pytest.approx(at, abs=within)
    if name == "overfitting":
        assert decision.values["held_out_completion_before"] > 85
    if name == "laps_slower":
        assert decision.values["lap_time_s_before"] == pytest.approx(6.0, abs=0.2)
        assert decision.values["lap_time_s_since"] > 1.03 * decision.values["lap_time_s_before"]
    assert_reported(decision)


def test_laps_are_judged_by_no_more_evaluations_than_an_average_is_of():
    patience = 5 * rule().window  # every fifth iteration is evaluated
    rows = slowing(lap_time_s=lambda i: 6.0 if i < 105 else 7.0)
    number, decision = stopped_at(rows, rule(f"stopping.laps_slower.patience={patience}"))
    assert (decision.rule, number) == ("laps_slower", 104 + patience)


@pytest.mark.parametrize(
    "rows",
    {
        "completion still grows": converging(30, completion=learned(LONG)),
        "the return still grows": converging(30, mean_return=learned(LONG)),
        "laps still grow": converging(30, laps_per_iteration=lambda i: 20 * i / LONG),
        "entropy still falls": converging(30, entropy=lambda i: 1 - 0.7 * i / LONG),
        "it drives worse than it did": converging(30, completion=lambda i: 98.0 if i < 60 else 80.0),
        "random but moves": history(60, **RANDOM | {"completion": lambda i: 11 + 0.3 * i}),
        "random but decides": history(60, **RANDOM | {"entropy": lambda i: 1 - 0.005 * i}),
        "random but drives": history(60, **RANDOM | {"completion": 60.0}),
        "no evaluations": falling(held_out=None),
        "held-out completion falls as laps become faster": falling(120, lap_time_s=lambda i: 9 - 4 * i / 120),
        "held-out completion rises": falling(held_out=learned(LONG)),
        "held-out completion holds": falling(held_out=80.0),
        "held-out completion wobbles": falling(held_out=lambda i: 80.0 + 4 * (-1) ** (i // 5)),
        "laps rise, but the race score improves": slowing(race_score_s=lambda i: 8 - 0.005 * i),
        "laps rise, and then none is reliable": slowing(
            lap_time_s=lambda i: 6.0 if i <= 100 else 6.5,
            evaluated_lap_share=lambda i: 1.0 if i <= 110 else 0.9,
        ),
        "laps hold": slowing(lap_time_s=lambda i: max(6.0, 8 - 2 * i / 60)),
        "laps become faster": slowing(lap_time_s=lambda i: 8 - 2 * i / LONG),
        "laps are slower by little": slowing(lap_time_s=lambda i: 6.0 if i <= 60 else 6.1),
        "laps are slower now and then": slowing(lap_time_s=lambda i: 7.0 if i % 100 > 40 else 6.0),
        "one lap was fast": slowing(lap_time_s=lambda i: 6.5 if i == 60 else 7.0),
        "fast laps were not reliable": slowing(
            lap_time_s=lambda i: 6.0 if i < 80 else 7.0, evaluated_lap_share=lambda i: 0.9 if i < 80 else 1.0
        ),
        "the return falls with the laps": slowing(mean_return=lambda i: 100 - 0.2 * i),
        "the return falls, too": falling(mean_return=lambda i: 100 - 0.2 * i),
    }.items(),
    ids=lambda rows: rows[0],
)
def test_a_run_for_which_no_rule_is_continues(rows):
    assert stopped_at(rows[1], rule()) == (None, None)


def test_a_policy_without_entropy_that_drives_well_has_not_collapsed():
    rows = history(completion=95.0, entropy=0.01)
    assert stopped_at(rows, rule("stopping.converged=null")) == (None, None)


@pytest.mark.parametrize("share", [0.98, 0.999])
def test_a_policy_that_has_just_been_evaluated_as_better_puts_off_the_end(share):
    """60 iterations after a gain of 2 per cent; one of a tenth per cent is none."""
    better_at = 105
    run = converging(30, race_score_s=lambda i: 10.0 * (share if i >= better_at else 1.0))
    number, decision = stopped_at(run, rule())
    assert decision.rule == "converged"
    assert number == (better_at + 60 if share < 0.99 else stopped_at(converging(30), rule())[0])


def test_no_verdict_comes_before_its_warm_up():
    rules = ("converged", "overfitting", "collapsed", "not_learning")
    lazy = [f"stopping.{name}.warmup=200" for name in rules]
    for rows in (
        converging(30),
        history(completion=11.0, entropy=0.999),
        history(completion=5.0, entropy=0.0),
    ):
        assert stopped_at(rows, rule(*lazy))[0] == 201


def test_a_rule_of_null_never_stops_a_run():
    rows = history(**RANDOM)
    assert stopped_at(rows, rule("stopping.not_learning=null", "stopping.converged=null")) == (None, None)


def test_the_thresholds_that_are_given_decide():
    rows = converging(30)
    early, _ = stopped_at(rows, rule("stopping.converged.patience=40", "stopping.converged.warmup=0"))
    late, _ = stopped_at(rows, rule("stopping.converged.patience=120"))
    assert early + 70 < late


def test_iterations_in_which_no_episode_ended_break_nothing():
    nothing, rows = {"completion": None, "mean_return": None}, converging(30)
    number, decision = stopped_at([row | (nothing if i % 3 else {}) for i, row in enumerate(rows)], rule())
    assert decision.rule == "converged"
    assert number == pytest.approx(112, abs=10)
    assert stopped_at([row | nothing for row in rows], rule()) == (None, None)


def test_the_entropy_of_a_choice_by_chance_is_one_whatever_the_number_of_actions():
    for actions in (2, 5, 27):
        assert entropy_share(math.log(actions), math.nan, actions) == pytest.approx(1)
    assert entropy_share(0.0, math.nan, 1) == 0.0


@pytest.mark.parametrize("std_at_start", [1.0, 0.5, 0.05])
def test_a_continuous_policy_is_measured_by_its_scatter_at_the_start(std_at_start):
    def entropy(std: float) -> float:
        return 2 * (0.5 * math.log(2 * math.pi * math.e) + math.log(std))

    start = entropy(std_at_start)
    for share in (1.5, 1.0, 0.5, 0.01):
        assert entropy_share(entropy(share * std_at_start), start, None) == pytest.approx(share)


def test_a_continuous_policy_that_keeps_its_scatter_is_not_learning():
    rows = history(completion=11.0, entropy=-0.3, laps_per_iteration=0.0)
    assert stopped_at(rows, rule(), None)[1].rule == "not_learning"


def led(rows: list[dict], target: float) -> list[dict]:
    """The same of a policy whose entropy a learned temperature leads to a target, in nats."""
    return [row | {"target_entropy": target} for row in rows]


@pytest.mark.parametrize("actions", [ACTIONS, None])
def test_a_policy_led_to_a_lower_entropy_that_does_not_drive_better_is_not_learning(actions):
    rows = led(history(completion=11.0, entropy=lambda i: max(0.3, 1 - 0.05 * i)), 0.3 * math.log(ACTIONS))
    number, decision = stopped_at(rows, rule(), actions)
    assert (decision.rule, decision.stopped_early) == ("not_learning", True)
    assert number < 60
    assert "of its target" in decision.why
    assert stopped_at(led(history(completion=learned(60)), 1.0), rule())[1].rule == "converged"


@pytest.mark.parametrize("actions", [ACTIONS, None])
def test_a_policy_far_below_the_entropy_it_is_led_to_has_collapsed(actions):
    target = 1.0
    below = target - 7.0 if actions is None else 0.02 * target
    rows = [
        row | {"entropy": max(below, target - row["env_steps"] / 8192)}
        for row in led(history(completion=20.0), target)
    ]
    assert stopped_at(rows, rule("stopping.not_learning=null"), actions)[1].rule == "collapsed"
    near = [row | {"entropy": target - 0.1} for row in rows]
    assert stopped_at(near, rule("stopping.not_learning=null"), actions)[1].rule != "collapsed"


def test_a_fixed_temperature_has_no_target_and_is_judged_as_any_policy():
    rows = history(**RANDOM)
    assert stopped_at([row | {"target_entropy": None} for row in rows], rule()) == stopped_at(rows, rule())


def test_reliable_counts_the_laps_of_the_last_evaluations():
    def row(laps: int | None) -> dict:
        # The training's own laps do not count.
        return {"lap_share": 1.0, "eval_laps": laps, "eval_laps_tried": None if laps is None else 10}

    of_three = rule("stopping.lap_share=0.9", "stopping.evaluations=3", option="reliable")
    laps = [10, 10, None, 6, None, 10, 10, None, 7]
    number, decision = stopped_at(list(map(row, laps)), of_three)
    assert number == len(laps)
    assert str(decision) == "reliable: 27 of 30 laps of the last 3 evaluations were complete"
    assert stopped_at(list(map(row, laps[:-1])), of_three) == (None, None)


def test_reliable_on_held_out_conditions_waits_for_them():
    def row(held_out: float) -> dict:
        return {"lap_share": 1.0, "eval_laps": 10, "eval_laps_tried": 10, "held_out_completion": held_out}

    asked = ("stopping.evaluations=2", "stopping.held_out_completion=80", "evaluation.held_out=sim2real")
    rows = list(map(row, [50.0, 90.0, 65.0, 94.0, 67.0]))
    number, decision = stopped_at(rows, rule(*asked, option="reliable"))
    assert number == len(rows)
    assert str(decision) == (
        "reliable: 20 of 20 laps of the last 2 evaluations were complete, and 80% of the way on held-out conditions"
    )
    assert stopped_at(rows[:-1], rule(*asked, option="reliable")) == (None, None)


@pytest.mark.parametrize("left_out", ["stopping.evaluations=null", "evaluation.held_out=null"])
def test_reliable_on_held_out_conditions_that_are_never_raced_is_refused(left_out):
    with pytest.raises(BadInput, match=rf"stopping\.held_out_completion=80: .* with {left_out}"):
        rule("stopping.held_out_completion=80", left_out, option="reliable_laps")


def test_reliable_of_evaluations_that_are_never_made_is_refused():
    with pytest.raises(BadInput, match=r"stopping\.evaluations=4: this training has no evaluations"):
        rule("checkpoints.every=null", option="reliable_laps")


def test_reliable_looks_at_the_share_of_laps():
    rows = history(lap_share=lambda i: None if i < 5 else i / 100)
    number, decision = stopped_at(rows, rule("stopping.episodes=20", option="reliable"))
    assert number == 90
    assert str(decision) == "reliable: 90% of the last 20 episodes completed the lap"
    assert stopped_at(rows, rule(option="none")) == (None, None)


@pytest.mark.parametrize("metric", ["completion", "mean_return", "held_out_completion"])
def test_plateau_looks_at_one_number(metric):
    rows = falling(completion=learned(100), mean_return=learned(200))
    number, decision = stopped_at(rows, rule(f"stopping.metric={metric}", option="plateau"))
    last_growth = {"completion": 100, "mean_return": 200, "held_out_completion": 50}[metric]
    assert number == pytest.approx(last_growth + 80, abs=12)
    assert decision.rule == "plateau"
    assert_reported(decision)
