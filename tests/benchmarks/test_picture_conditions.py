from benchmarks.picture_conditions import conditions
from deepracer_exp.config.compose import compose_experiment


def test_conditions_of_one_quantity_lie_beyond_what_was_trained_on():
    trained = compose_experiment(["randomization=sim2real"])[0].randomization.pictures
    under = conditions(trained)
    single = {
        name: one for name, one in under.items() if " " in name and not name.startswith(("all", "trained"))
    }
    assert {name.split()[0] for name in single} == set(vars(trained))
    for name, one in single.items():
        quantity, value = name.split()
        low, high = getattr(trained, quantity)
        assert not low <= float(value) <= high
        at_rest = {
            key for key, ends in vars(one).items() if tuple(ends) == ((1, 1) if "scale" in key else (0, 0))
        }
        assert at_rest == set(vars(trained)) - {quantity}
