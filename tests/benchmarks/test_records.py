import json
from dataclasses import replace

import pytest

from benchmarks import records
from deepracer_exp.tracks import boards


@pytest.mark.slow
def test_laps_stand_beside_the_fastest_lap_its_bound_and_the_record(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (board, *_) = boards.boards()
    monkeypatch.setattr(
        records, "boards_of", lambda _: (board, replace(board, date="2022-08-01", record_s=3.0))
    )
    asked = ["--seeds", "1", "--steps", "32768", "--tracks", "Straight_track"]
    assert records.main([*asked, "--json", str(tmp_path / "records.json")]) == 0
    found = json.loads((tmp_path / "records.json").read_text())
    own, official = found["tracks"]["Straight_track"], found["official"]["Straight_track"]
    assert own["bound_s"] <= own["fastest_s"] < 2.5
    assert (official["car"], official["record_s"]) == ("deepracer_v5", 3.0)
    assert len(own["laps_s"]) == len(official["flying_laps_s"]) == 1
    assert "Straight_track" in capsys.readouterr().out
