import pytest

from deepracer_exp.commands.validation.aws_rules import style_findings, text_findings

GOOD = '''\
import math


def reward_function(params):
    """Pay for speed."""
    return math.sqrt(params['speed']) + 1e-3
'''


def findings(text: str) -> list[str]:
    return [str(finding) for finding in text_findings(text)]


def test_a_plain_function_is_taken():
    assert findings(GOOD) == []


@pytest.mark.parametrize("module", ["math", "random", "numpy", "scipy.optimize", "shapely.geometry"])
def test_the_modules_of_the_console_are_allowed(module):
    assert not any("import of" in line for line in findings(f"import {module}\n{GOOD}"))


@pytest.mark.parametrize(
    "line", ["import os", "from os import path", "import sys as math", "from . import x"]
)
def test_other_modules_are_not(line):
    (found,) = [text for text in findings(f"{line}\n{GOOD}") if "import of" in text]
    assert found.startswith("line 1: import of ")


@pytest.mark.parametrize("name", ["open", "exec", "eval", "compile", "input"])
def test_a_call_of_a_forbidden_built_in_is_found_even_as_an_argument(name):
    for text in (f"{name}('x')", f"max(1.0, float({name}('x')))"):
        assert findings(GOOD.replace("return", f"n = {text}\n    return n *")) == [
            f"line 6: use of {name}, which is forbidden"
        ]


def test_a_forbidden_built_in_is_not_found_where_the_validator_does_not_look():
    """It looks for the whole dotted name, and not into keyword arguments."""
    for text in ("open", "open('x').read()", "max((1, 2), key=eval('x'))"):
        assert findings(GOOD.replace("return", f"n = {text}\n    return n and")) == []


UNNAMED = [
    *(
        "'{}'.format(1)",
        "params['waypoints'].copy()",
        "(1.0 + 2.0).real",
        "(lambda: 1.0)()",
        "[1.0].index(1.0)",
    ),
    *("max(0, params['x'].real)", "math.floor(-params['x'].real)"),
]


@pytest.mark.parametrize("expression", UNNAMED)
def test_a_call_or_attribute_that_does_not_begin_with_a_name_is_refused(expression):
    (found,) = text_findings(GOOD.replace("1e-3", f"float(bool({expression}))"))
    assert (found.line, found.rule) == (6, "validator")
    assert "give this part a name first" in found.text


@pytest.mark.parametrize("expression", ["str(1).format(1)", "math.pi.real", "max(1, 2).real", "f'{math.pi}'"])
def test_a_chain_that_begins_with_a_name_is_accepted(expression):
    assert findings(GOOD.replace("1e-3", f"float(bool({expression}))")) == []


def test_a_method_of_a_forbidden_name_is_no_built_in():
    assert findings(GOOD.replace("params['speed']", "math.pi.compile")) == []


@pytest.mark.parametrize(
    "word",
    [
        *("__import__", "load", "loadtxt", "fromfile", "genfromtxt", "tofile", "save", "savetxt", "savez"),
        "memmap",
    ],
)
def test_forbidden_words_are_found_in_comments_too(word):
    assert findings(f"{GOOD}# my {word} of it\n") == [
        f"line 7: the word {word}, forbidden anywhere in the text"
    ]


def test_a_form_feed_is_no_line():
    text = GOOD.replace("\n\n\ndef", "\n\x0c\n\ndef")
    assert findings(f"{text}# load\n") == ["line 7: the word load, forbidden anywhere in the text"]


def test_a_word_inside_a_longer_one_is_refused_and_shown():
    text = GOOD.replace("return", "payload = 1\n    return payload *")
    assert "line 6: the word load (in payload), forbidden anywhere in the text" in findings(text)


def test_code_beyond_140_000_characters_is_refused():
    most = GOOD + "#" * (140_000 - len(GOOD) - 1) + "\n"
    assert not any("characters of code" in line for line in findings(most))
    assert findings(most + "\n\n")[0] == "140,002 characters of code; at most 140,000 are accepted"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (GOOD.replace("return math", "return  math"), "E271"),
        (GOOD.replace("\n\n\ndef", "\n\ndef"), "E302"),
        (GOOD.replace("    return", "   return").replace('    """', '   """'), "E111"),
        (GOOD.replace("math.sqrt", "mth.sqrt"), "undefined name 'mth'"),
        (GOOD.replace("math.sqrt", ""), "'math' imported but unused"),
    ],
)
def test_style_codes_of_flake8s_e_and_f_are_reported(text, code):
    assert any(code in finding.text for finding in style_findings(text))


@pytest.mark.parametrize(
    "text",
    [
        GOOD.replace("1e-3", "1e-3" + " + 1e-3" * 40),  # E501
        GOOD.replace("1e-3", "2*3 # six"),  # E226, E261
        GOOD + "\n\n",  # W391
        GOOD.replace("import math", "import math, random  # noqa"),
        GOOD.replace("import math", "import math, random  # noqa: E401, F401"),
    ],
)
def test_what_the_console_does_not_look_at_is_not_reported(text):
    assert style_findings(text) == []


def test_each_finding_says_whose_rule_it_is():
    text = "import os\n" + GOOD.replace("\n\n\ndef", "\n\ndef").replace("1e-3", "float(os.sep.join('load'))")
    rules = {finding.rule: str(finding) for finding in text_findings(text)}
    assert rules["documented"].startswith("line 1: import of os")
    assert rules["validator"] == "line 6: the word load, forbidden anywhere in the text"
    assert rules["style"] == "line 4: E302 expected 2 blank lines, found 1"


def test_a_noqa_of_another_code_excuses_nothing():
    assert len(style_findings(GOOD.replace("import math", "import math, random  # noqa: E701"))) == 2
