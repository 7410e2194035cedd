import pytest
from pydantic import TypeAdapter

from deepracer_exp.agents.schedules import PresetSchedule
from deepracer_exp.config.learning import LRScheduleConfig

PARAMETERS = {
    "constant": {},
    "linear": {"length": 10, "end_factor": 0.2},
    "cosine": {"length": 10, "end_factor": 0.2},
    "step": {"length": 5, "factor": 0.5},
    "exponential": {"length": 5, "factor": 0.25},
    "adaptive_kl": {"target_kl": 0.01, "step_factor": 2.0, "lowest_factor": 0.3, "highest_factor": 3.0},
}


def make(kind: str, by: str = "iteration", warmup: float = 0, **changes: float) -> PresetSchedule:
    values = {"kind": kind, "by": by, "warmup": warmup, **PARAMETERS[kind], **changes}
    return PresetSchedule(TypeAdapter(LRScheduleConfig).validate_python(values))


@pytest.mark.parametrize(
    ("kind", "start", "middle", "end", "after"),
    [
        ("constant", 1, 1, 1, 1),
        ("linear", 1, 0.6, 0.2, 0.2),
        ("cosine", 1, 0.6, 0.2, 0.2),
        ("step", 1, 0.5, 0.25, 0.125),
        ("exponential", 1, 0.25, 0.0625, 0.015625),
        ("adaptive_kl", 1, 1, 1, 1),
    ],
)
def test_start_middle_and_end_are_as_named_in_both_units(kind, start, middle, end, after):
    expected = [start, middle, end, after]
    by_iteration = make(kind)
    assert [by_iteration.factor(i, 0.0) for i in (0, 5, 10, 15)] == pytest.approx(expected)
    if "length" in PARAMETERS[kind]:
        by_fraction = make(kind, by="fraction", length=PARAMETERS[kind]["length"] / 10)
    else:
        by_fraction = make(kind, by="fraction")
    assert [by_fraction.factor(7, f) for f in (0.0, 0.5, 1.0, 1.5)] == pytest.approx(expected)


def test_a_step_falls_at_the_length_and_not_before():
    schedule = make("step")
    assert [schedule.factor(i, 0) for i in (4, 5, 9, 10)] == [1, 0.5, 0.5, 0.25]


@pytest.mark.parametrize("kind", PARAMETERS)
def test_the_warm_up_rises_from_above_zero_to_the_schedule_itself(kind):
    plain, warm = make(kind), make(kind, warmup=4)
    ratios = [warm.factor(i, 0) / plain.factor(i, 0) for i in range(6)]
    assert ratios == pytest.approx([0.25, 0.5, 0.75, 1, 1, 1])


def test_a_warm_up_by_fraction_learns_at_fraction_zero():
    schedule = make("constant", by="fraction", warmup=0.2)
    assert 0 < schedule.factor(0, 0.0) < 0.05
    assert schedule.factor(0, 0.1) == pytest.approx(0.5)
    assert schedule.factor(0, 0.2) == 1


def test_the_adaptive_rate_falls_after_long_steps_and_rises_after_short_ones():
    schedule = make("adaptive_kl")
    schedule.observe(0.021)
    assert schedule.factor(1, 0) == 0.5
    schedule.observe(0.01)
    assert schedule.factor(2, 0) == 0.5
    schedule.observe(0.004)
    assert schedule.factor(3, 0) == 1


def test_the_adaptive_rate_stays_within_its_bounds():
    schedule = make("adaptive_kl")
    for kl, bound in ((1.0, 0.3), (0.0, 3.0)):
        for _ in range(10):
            schedule.observe(kl)
        assert schedule.factor(1, 0) == bound


def test_only_the_adaptive_rate_listens_to_the_kl():
    schedule = make("linear")
    schedule.observe(100.0)
    assert schedule.factor(0, 0) == 1


def test_a_restored_adaptive_rate_continues_where_it_was():
    one, other = make("adaptive_kl"), make("adaptive_kl")
    one.observe(1.0)
    other.load_state_dict(one.state_dict())
    assert other.factor(1, 0) == one.factor(1, 0) == 0.5
