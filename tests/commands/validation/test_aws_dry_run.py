import pytest

from deepracer_exp.commands.validation.aws_dry_run import dry_run_findings, validator_params
from deepracer_exp.commands.validation.aws_rules import text_findings

pytestmark = pytest.mark.processes

ACCEPTED = [
    *("np.float64(2.0)", "params['x']", "-1e5"),
    "float(params['steps'] + np.sum(params['waypoints']) > 0) + float(len(params['objects_location']) == 6)",
]
REFUSED = [
    ("1", "line 5 returned 1 of type int; accepted: a float from -100000 to 100000"),
    ("params['progress'] > 50", "of type bool"),
    ("np.float32(1)", "of type float32"),
    (
        "params['speed']",
        "returned 1 of type int; accepted: a float from -100000 to 100000, called off the track",
    ),
    ("float('nan')", "returned nan of type float"),
    ("100001.0", "returned 100001.0 of type float"),
    ("params['steps'] / params['progress']", "raised ZeroDivisionError: division by zero in line 5 of"),
    ("1.0 if params['waypoints'] else 0.1", "raised ValueError: The truth value of an array"),
    ("float(params['waypoints'].index((0, 0)))", "raised AttributeError"),
    ("params['projection_distance']", "raised KeyError"),
    ("params['objects_distance_from_center'][0]", "raised KeyError"),
]


def function(expression: str, head: str = "") -> str:
    return f"import numpy as np\n\n\ndef reward_function(params):\n    {head}return {expression}\n"


@pytest.fixture
def findings(race_with):
    def find(text: str) -> list[str]:
        setup = race_with(text)
        return [str(finding) for finding in dry_run_findings(setup.reward, setup.track)]

    return find


@pytest.mark.parametrize("expression", ACCEPTED)
def test_a_float_within_the_bounds_is_accepted(findings, expression):
    assert findings(function(expression)) == []


@pytest.mark.parametrize(("expression", "words"), REFUSED)
def test_what_the_validator_refuses_after_a_call_is_found(findings, expression, words):
    assert words in findings(function(expression))[0]


@pytest.mark.parametrize(
    ("parameters", "accepted"),
    [("params", True), ("*params", True), ("params, debug=False", False), ("params, *, debug=False", False)],
)
def test_one_parameter_is_accepted(findings, parameters, accepted):
    text = f"def reward_function({parameters}):\n    return 1.0\n"
    assert ["exactly one parameter" in line for line in findings(text)] == [True] * (not accepted)


def test_an_import_is_refused_where_it_is_executed_while_the_function_is_called(findings):
    body = "if params['steps'] {}:\n        import random\n        random.random()\n    "
    (found,) = findings(function("1.0", body.format("== 1")))
    assert found == (
        "line 6: random is imported while the function is called; imports belong at the top of the file"
    )
    assert findings(function("1.0", body.format("> 1"))) == []


@pytest.mark.parametrize("expression", ["{}.sum()", "np.average({})", "np.clip(1.0, {}, 2.0)[0]"])
def test_methods_of_arrays_that_import_a_module_in_the_validator_are_found(findings, expression):
    text = function(f"float({expression.format('a')})", "a = np.ones(3)\n    ")
    (found,) = findings(text)
    assert "imports a module while the function is called" in found


def test_a_module_that_a_library_loads_while_the_function_is_called_is_found(findings):
    (found,) = findings(function("float(np.random.uniform())"))
    assert found.startswith("numpy.random is imported while the function is called")
    assert findings("import numpy.random  # noqa: F401\n" + function("float(np.random.uniform())")) == []


def test_a_method_that_the_text_defines_is_no_array_s(findings):
    head = "class Lap:\n    def max(self):\n        return 1.0\n\n\nlap = Lap()\n"
    assert findings(head + function("lap.max()")) == []


def test_functions_of_numpy_are_accepted(findings):
    names = ("sum", "all", "max", "mean", "std", "linalg.norm", "argmin")
    called = " + ".join(f"np.{name}(a)" for name in names)
    assert findings(function(f"float({called})", "a = np.ones(3)\n    ")) == []


@pytest.mark.parametrize("value", ["5", "None", "max"])
def test_what_is_no_function_is_refused_in_one_line(findings, value):
    (found,) = findings(f"reward_function = {value}\n")
    assert found.startswith(f"reward_function is {'<built-in function max>' if value == 'max' else value}")


def test_what_a_function_writes_is_no_result(findings):
    writes = "os.write(1, b'[]'); sys.stdout.write('[]')\n    "
    assert findings("import os\nimport sys\n" + function("1.0", writes)) == []


@pytest.mark.parametrize("line", ["os._exit(0)", "os._exit(7)", "sys.exit(0)"])
def test_a_function_that_leaves_its_process_is_refused(findings, line):
    assert findings("import os\nimport sys\n" + function("1.0", f"{line}\n    "))
    assert findings(f"import os\nimport sys\n{line}\n" + function("1.0"))


def test_a_function_that_hangs_is_refused(findings, monkeypatch):
    monkeypatch.setattr("deepracer_exp.commands.validation.aws_dry_run._LIMIT_S", 0.2)
    text = function("1.0", "while params['progress'] == 0:\n        pass\n    ")
    for hangs in (text, text.replace("progress'] == 0", "progress'] == 50")):
        (found,) = findings(hangs)
        assert "took longer" in found


def test_what_only_the_function_assigns_is_kept_and_what_the_module_assigns_is_not(findings):
    body = (
        "global seen, last\n    if params['steps'] == 1:\n        seen = 1.0\n    was, last = last, 2.0\n    "
    )
    assert findings("last = 0.0\n" + function("seen / (was == 0.0)", body)) == []


def test_the_situations_are_those_of_the_validator(race):
    situations = validator_params(race.track)
    assert [len(params) for params in situations.values()] == [24] * 5
    assert [params["progress"] for params in situations.values()] == [0, 0, 50, 0, 100]
    assert [params["steps"] for params in situations.values()] == [1, 1, 100, 1, 10_000]
    beside = situations["off the track"]
    assert beside["is_offtrack"]
    assert beside["distance_from_center"] == beside["track_width"]


def test_what_the_validator_itself_refused_is_refused_here(race_with, findings, reference):
    """Every file of the folder was refused by the validator itself."""
    for file in sorted((reference / "inputs/validator").glob("*.py")):
        text = file.read_text(encoding="utf-8")
        assert [found for found in text_findings(text) if found.rule != "style"] or findings(text), file.name
