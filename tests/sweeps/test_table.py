"""The view of a sweep in a terminal."""

import io
from types import SimpleNamespace

from rich.console import Console

from sweeps.ledger import Slot
from sweeps.table import SweepView

CONFIG = SimpleNamespace(trials=4, objectives=("race_score",))
PLAN = SimpleNamespace(study="spring", config=CONFIG, folder="runs/spring")


def slot(number, outcome=None, values=None, **attrs):
    state = "claimed" if outcome is None else "told"
    progress = {"number": number, "env_steps": 8192, "completion": 51.0, "entropy": 2.31}
    return Slot(
        number,
        1,
        "host:1:a",
        state,
        outcome,
        values,
        {"number": number, **attrs},
        number,
        (),
        progress,
        False,
    )


def shown(slots, is_terminal=True, first=()):
    text = io.StringIO()
    console = Console(file=text, force_terminal=is_terminal, width=100, height=30, color_system=None)
    with SweepView(PLAN, 2, console) as view:
        view.show(first)
        view.show(slots)
    return text.getvalue()


ENDED = [
    slot(0, "COMPLETE", [8.25], fate="converged", env_steps=8192, lap_time_s=8.1, completion=98.0),
    slot(1, "PRUNED", None, fate="collapsed", env_steps=4096, reason="collapsed: entropy 0.01"),
]


def test_it_tells_how_many_trials_ended_how_and_which_is_best():
    view = shown([*ENDED, slot(2)])
    for words in ("2 of 4: 1 done, 1 pruned, 0 failed", "trial 0, race score 8.25 s", "8,192", "51 %"):
        assert words in view


def test_the_rest_of_a_trial_from_before_says_nothing_of_the_time_that_is_left():
    assert "an hour" in shown([*ENDED, slot(2)])
    under_way = [slot(0), slot(1)]
    assert "an hour" not in shown([*ENDED, slot(2)], first=under_way)
    assert "an hour" in shown([*ENDED, slot(2, "COMPLETE", [9.0])], first=under_way)


def test_before_the_first_trial_it_says_what_is_waited_for():
    assert "workers start" in shown([])


def test_without_a_terminal_each_trial_that_ends_is_a_line():
    lines = shown(ENDED, is_terminal=False).splitlines()
    assert lines[0] == "spring: 4 trials, 2 workers; runs in runs/spring"
    assert lines[1].startswith("trial 0 done (converged) after 8,192 steps: race score 8.25 s")
    assert lines[2] == "trial 1 pruned (collapsed) after 4,096 steps: collapsed: entropy 0.01"
    assert len(lines) == 3
