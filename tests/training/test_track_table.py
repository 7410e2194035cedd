import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.training.display import TrackTable


@given(
    st.lists(st.text("abcdef_", min_size=1, max_size=40), min_size=1, max_size=60, unique=True),
    st.integers(24, 120),
    st.integers(2, 40),
)
def test_it_keeps_within_its_width_and_room_and_leaves_no_track_uncounted(labels, width, room):
    table = TrackTable(labels)
    lines = [line.plain for line in table.lines(width, room)]
    assert len(lines) <= room
    assert all(len(line) <= width for line in lines)
    # Each track has two dashes, since nothing is known of it yet.
    shown = sum(line.count("\N{EN DASH}") for line in lines) // 2
    left_out = [line.split("and ")[1].split(" more")[0] for line in lines if " more" in line]
    assert shown + sum(map(int, left_out)) == len(labels)


def test_names_that_are_too_long_keep_both_ends():
    text = "\n".join(
        line.plain for line in TrackTable(["reInvent2019_track", "reInvent2019_wide"]).lines(24, 9)
    )
    assert "reIn" in text
    assert "track " in text
    assert "wide " in text


@pytest.mark.parametrize("missing", [None, float("nan")])
def test_a_figure_stays_until_there_is_a_new_one(missing):
    table = TrackTable(["a", "b"])
    table.add({"completion/a": 40.0, "completion/b": 70.0, "best_lap_time_s/b": 9.25})
    table.add({"completion/a": missing, "completion/b": 30.0})
    assert table.least() == "least 30.0 % on b"
    (_, a, b) = (line.plain.split() for line in table.lines(24, 9))
    assert a == ["a", "40", "\N{EN DASH}"]
    assert b == ["b", "30", "9.25"]
