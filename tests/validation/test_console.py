import pytest

from deepracer_exp.validation.console import console_findings, style_findings

GOOD = '''\
import math


def reward_function(params):
    """Pay for speed."""
    return math.sqrt(params['speed']) + 1e-3
'''


def findings(text: str) -> list[str]:
    return [str(finding) for finding in console_findings(text)]


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


def test_an_import_inside_a_function_is_refused():
    text = GOOD.replace('    """Pay', '    import random\n    """Pay')
    assert any("line 5: an import that is not at the top of the file" in line for line in findings(text))


@pytest.mark.parametrize("name", ["open", "exec", "eval", "compile", "input"])
def test_forbidden_built_ins_are_found_even_where_they_are_not_called(name):
    text = GOOD.replace("return", f"f = {name}\n    return f and")
    assert f"line 6: use of {name}, which is forbidden" in findings(text)


def test_a_method_of_a_forbidden_name_is_no_built_in():
    assert findings(GOOD.replace("params['speed']", "params['speed'].real.compile")) == []


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


def test_a_noqa_of_another_code_excuses_nothing():
    assert len(style_findings(GOOD.replace("import math", "import math, random  # noqa: E701"))) == 2
