import json

from benchmarks import lap_bounds


def test_only_time_trials_of_the_fast_era_count(tmp_path, capsys):
    file = tmp_path / "boards.csv"
    file.write_text(
        "world,race_type,date,best_lap_s\n"
        "reInvent2019_track,TIME_TRIAL,2019-10-01,1.0\n"
        "reInvent2019_track,TIME_TRIAL,2020-11-01,7.5\n"
        "reInvent2019_track,OBJECT_AVOIDANCE,2020-11-01,2.0\n"
        "elsewhere,TIME_TRIAL,2020-11-01,9.0\n"
    )
    assert lap_bounds.main(["--anchors", str(file), "--json", str(tmp_path / "bounds.json")]) == 0
    said = capsys.readouterr()
    assert "1 of 1 worlds" in said.out
    assert "elsewhere: not in the catalogue" in said.err
    (row,) = json.loads((tmp_path / "bounds.json").read_text())["worlds"]
    assert row["record_s"] == 7.5


def test_an_unknown_car_is_refused_in_one_line(tmp_path, capsys):
    file = tmp_path / "boards.csv"
    file.write_text("world,race_type,date,best_lap_s\n")
    assert lap_bounds.main(["--anchors", str(file), "--car", "nope"]) == 2
    assert capsys.readouterr().err.startswith("car=nope: no such car; options: deepracer,")
