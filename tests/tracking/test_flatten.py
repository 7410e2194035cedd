import json

from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.tracking.metadata import LONGEST_PARAM, flatten, param_text

keys = st.text("abc_", min_size=1, max_size=4)
leaves = st.none() | st.booleans() | st.integers() | st.text(max_size=5) | st.lists(st.integers(), max_size=3)
configs = st.recursive(
    st.dictionaries(keys, leaves, max_size=4),
    lambda inner: st.dictionaries(keys, inner | leaves, max_size=4),
    max_leaves=10,
)


@given(configs)
def test_every_leaf_is_found_under_its_dotted_key(config):
    flat = flatten(config)

    def check(node, path):
        for key, value in node.items():
            here = (*path, key)
            if isinstance(value, dict) and value:
                check(value, here)
            elif isinstance(value, list | dict):
                assert json.loads(flat.pop(".".join(here))) == value
            else:
                assert flat.pop(".".join(here)) == value

    check(config, ())
    assert flat == {}


def test_values_are_written_as_in_yaml():
    assert [param_text(value) for value in (None, True, False, 3, 3e-4, "mlp")] == [
        *("null", "true", "false", "3", "0.0003", "mlp")
    ]


@given(st.text(min_size=LONGEST_PARAM + 1, max_size=LONGEST_PARAM + 50), st.text(max_size=5))
def test_long_values_are_cut_but_stay_distinguishable(text, end):
    cut = param_text(text)
    assert len(cut) == LONGEST_PARAM
    assert (param_text(text + end) == cut) == (end == "")
