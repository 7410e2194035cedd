import json
from dataclasses import replace

from benchmarks import lap_bounds
from deepracer_exp.tracks.boards import boards_of


def test_each_car_of_a_world_is_held_against_its_own_fastest_lap(tmp_path, capsys, monkeypatch):
    (board, *_) = boards_of("reInvent2019_track")
    rows = (
        replace(board, date="2020-11-01", record_s=7.5),
        replace(board, date="2021-03-01", record_s=7.0),
        replace(board, date="2022-08-01", record_s=2.0),
        replace(board, world="elsewhere"),
    )
    monkeypatch.setattr(lap_bounds, "boards", lambda: rows)
    # What a car can do and the bound that follows take seconds each, and have tests of their own.
    bounds_s = {"deepracer_v4": 6.5, "deepracer_v5": 6.0}
    monkeypatch.setattr(lap_bounds, "ability", lambda car: car.name)
    monkeypatch.setattr(lap_bounds, "fastest_line", lambda track, reach_m, car: (bounds_s[car], None))
    assert lap_bounds.main(["--json", str(tmp_path / "bounds.json")]) == 0
    printed = capsys.readouterr()
    assert "1 of 2: the bound is below the record" in printed.out
    assert "elsewhere: not in the catalogue" in printed.err
    worlds = json.loads((tmp_path / "bounds.json").read_text())["worlds"]
    assert [(row["car"], row["record_s"], row["bound_s"], row["below"]) for row in worlds] == [
        ("deepracer_v4", 7.0, 6.5, True),
        ("deepracer_v5", 2.0, 6.0, False),
    ]
