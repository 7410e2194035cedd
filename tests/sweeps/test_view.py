"""The view of a sweep in a terminal."""

import io
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.commands.output import plain_console
from deepracer_exp.sweeps.queue.claims import Claim
from deepracer_exp.sweeps.report.view import SweepView
from deepracer_exp.sweeps.trial import SeedRun, Trial
from deepracer_exp.training.display import LINE_COLUMNS

CONFIG = SimpleNamespace(trials=4, objectives=("race_score",))
WORKER_CONFIG = SimpleNamespace(study="spring", config=CONFIG, folder="runs/spring")


def claim(number, state=None, values=None, share=0.0, params=None, **attrs):
    progress = {"env_steps": 8192, "completion": 51.0, "entropy": 2.31}
    progress |= {"share": share, "params": params or {}}
    runs = (SeedRun(seed=0, values=values, **attrs),) if state else ()
    trial = Trial(number=number, state=state or "RUNNING", values=values, runs=runs)
    return Claim(
        trial=trial, attempt=1, owner="host:1:a", is_reported=bool(state), progress=progress, expired=False
    )


def shown(claims, is_terminal=True, first=(), after_s=0.0):
    text = io.StringIO()
    console = plain_console(file=text, force_terminal=is_terminal, width=100, height=30, color_system=None)
    with SweepView(WORKER_CONFIG, 2, console) as view:
        view.show(first)
        view._began -= after_s
        view.show(claims)
    return text.getvalue()


def test_a_trial_of_an_algorithm_without_entropy_is_shown():
    one = claim(0)
    one.progress["entropy"] = None
    assert "8,192" in shown([one])


ENDED = [
    claim(
        0,
        "COMPLETE",
        [8.25],
        ending="converged",
        env_steps=8192,
        lap_time_s=8.1,
        completion=98.0,
        held_out_completion=80.0,
    ),
    claim(1, "PRUNED", None, ending="collapsed", env_steps=4096, reason="collapsed: entropy 0.01"),
]


def test_it_counts_trials_by_state_and_names_the_best():
    view = shown([*ENDED, claim(2)])
    for words in (
        "2 of 4: 1 done, 1 pruned, 0 failed",
        "trial 0, race score (usual and held-out) 8.25 s, mean usual lap 8.10 s, 98% driven",
        "8,192",
        "51%",
    ):
        assert words in view


@pytest.mark.processes
def test_the_time_left_is_estimated_from_the_pace_of_this_start_only():
    assert "min left" in shown([*ENDED, claim(2)], after_s=600)
    assert "not known yet" in shown([*ENDED, claim(2)], first=[*ENDED, claim(2)], after_s=600)
    # Two of four were there; half of the third in ten minutes: thirty for the rest.
    half = claim(2, share=0.5)
    assert "about 30 min left" in shown([*ENDED, half], first=ENDED, after_s=600)


def test_it_shows_the_values_of_a_trial_from_its_start_on():
    params = {"algorithm.lr": 0.00031234, "network": "mlp_small"}
    begun = claim(2)
    begun.progress.clear()
    begun.progress.update(params=params, share=0.0)
    for view in (shown([begun]), shown([claim(2, params=params)])):
        assert "lr 0.000312" in view
        assert "mlp_small" in view


def test_before_the_first_trial_it_says_that_workers_start():
    assert "workers start" in shown([])


def test_without_a_terminal_each_trial_that_ends_is_a_line():
    lines = shown(ENDED, is_terminal=False).splitlines()
    assert lines[:2] == ["spring: 4 trials, 2 workers", "runs in runs/spring"]
    said = " ".join(map(str.strip, lines[2:]))
    assert (
        "left: trial 0 done (converged) after 8,192 steps: race score (usual and held-out) 8.25 s, "
        "mean usual lap 8.10 s, 98% driven" in said
    )
    assert "left: trial 1 pruned after 4,096 steps: collapsed: entropy 0.01" in said
    assert said.count("2 of 4, about") == 2


@given(
    st.dictionaries(
        st.text("abc_.", min_size=1, max_size=60), st.floats() | st.text("xyz-", max_size=40), max_size=12
    ),
    st.text("abc ", max_size=500),
)
def test_no_line_of_a_trial_is_wider_than_120_columns_and_none_of_its_values_is_lost(params, reason):
    many = {f"key{number}.{key}": value for number, (key, value) in enumerate(params.items())}
    names = ("race_score", "lap_time", "completion", "zigzag")
    config = SimpleNamespace(
        study="spring", config=SimpleNamespace(trials=4, objectives=names), folder="runs"
    )
    ended = [
        claim(0, "COMPLETE", [108.25, 108.1, 100.0, 10.0], ending="converged", completion=100.0, params=many),
        claim(1, "FAIL", None, ending="failed", reason=reason, params=many),
    ]
    text = io.StringIO()
    with SweepView(config, 2, plain_console(file=text, width=80)) as view:
        view.show([])
        view.show(ended)
    assert max(map(len, text.getvalue().splitlines())) <= LINE_COLUMNS == 120
    squeezed = "".join(text.getvalue().split())
    assert "".join(reason.split()) in squeezed
    assert all("".join(key.rpartition(".")[2].split()) in squeezed for key in many)


def test_without_held_out_laps_the_race_score_is_that_of_the_usual_ones():
    ended = claim(0, "COMPLETE", [8.25], completion=98.0)
    assert "race score (usual) 8.25 s" in shown([ended], is_terminal=False)


def test_values_keep_their_brackets():
    ended = claim(0, "COMPLETE", [8.25], params={"track": "[reinvent_base]"}, completion=98.0)
    assert "track [reinvent_base]" in shown([ended], is_terminal=False)
    assert "track [bold]" in shown([claim(1, params={"track": "[bold]"})])
