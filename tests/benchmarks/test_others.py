import json

from benchmarks import others


def test_crashes_of_a_recorded_training_with_a_bot_are_found_to_one_row_in_a_thousand(tmp_path, reference):
    assert others.main(["--traces", str(reference), "--json", str(tmp_path / "others.json")]) == 0
    figures = json.loads((tmp_path / "others.json").read_text())
    assert figures["rows"] == 20847
    assert figures["crashes"] == 15
    assert figures["wrong_rows"] <= figures["rows"] / 1000
    assert figures["crashes_found"] >= 8
    assert len(figures["recordings"][0]["mismatches"]) == figures["wrong_rows"]
