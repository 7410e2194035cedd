from deepracer_exp.commands.validation.coverage import Coverage, never_executed

TEXT = '''\
def helper(x):
    """Docstring."""
    if x > 5:
        return 1
    return 0


def unused(x):
    return 2


class Kept:
    def at_most(self, x):
        if x > 8:
            return 8
        return x


def reward_function(params):
    if params["a"] > 0:
        r = helper(Kept().at_most(params["a"]))
        r += 1
    elif params["a"] < -10:
        r = 3
        r += 4
    else:
        r = 5
    for _ in params["objects"]:
        r += 6
    try:
        r = r / params["b"]
    except ZeroDivisionError:
        r = 7
    return r
'''


def missed(*calls: dict) -> list[tuple[int, int]]:
    namespace: dict = {}
    exec(compile(TEXT, "mine.py", "exec"), namespace)
    with Coverage("mine.py") as coverage:
        for call in calls:
            namespace["reward_function"](call)
    return never_executed(TEXT, coverage.lines)


def test_statements_never_reached_are_found_in_every_function_that_was_entered():
    assert missed({"a": 1, "b": 1, "objects": []}, {"a": -1, "b": 1, "objects": []}) == [
        (4, 4),
        (15, 15),
        (24, 25),
        (29, 29),
    ]


def test_nothing_is_missed_once_every_branch_was_taken():
    calls = [{"a": a, "b": 1, "objects": [1]} for a in (1, 9, -1, -11)]
    assert missed(*calls) == []


def test_the_tracer_that_was_at_work_continues_afterwards():
    import sys

    before = sys.gettrace()
    with Coverage("mine.py"):
        assert sys.gettrace() is not before
    assert sys.gettrace() is before
