import json
from dataclasses import replace

import pytest

from benchmarks import records
from benchmarks.fresh import Driven
from deepracer_exp.tracks import boards


def policy(lap_time_s, lap_share=1.0):
    return Driven(
        completion=100.0,
        lap_share=lap_share,
        lap_time_s=lap_time_s,
        held_out_completion=0.0,
        held_out_lap_time_s=None,
    )


def test_a_seed_without_a_lap_is_slower_than_any():
    found = records.figures(4.0, 4.1, [policy(4.4), policy(None, 0.0), policy(4.2, 0.5)])
    assert found["best_s"] == 4.2
    assert found["median_s"] == pytest.approx(4.4)
    assert found["completion"] == 0.5
    lost = records.figures(4.0, 4.1, [policy(4.4), policy(None, 0.0)])
    assert lost["median_s"] is lost["median_over_fastest"] is None


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


def test_no_seed_is_refused(capsys):
    assert records.main(["--seeds", "0"]) == 2
    assert "--seeds" in capsys.readouterr().err
