import pytest

from benchmarks.real_car import summarize


def test_what_randomization_gains_is_compared_seed_by_seed():
    def driven(share, time_s):
        return {"car": {"lap_share": share, "completion": share, "lap_time_s": time_s}}

    seeds = [
        {"without": driven(0.2, None), "with": driven(0.8, 10.0)},
        {"without": driven(0.4, 9.0), "with": driven(1.0, 11.0)},
        {"without": driven(0.0, 8.0), "with": driven(0.3, 10.5)},
    ]
    found = summarize(seeds)["car"]
    assert found["lap_share"]["with"]["mean"] == pytest.approx(0.7)
    assert found["lap_share"]["gain"]["mean"] == pytest.approx(0.5)
    # Student's t of three: 4.303 standard errors of 0.1.
    assert found["lap_share"]["gain"]["interval"] == pytest.approx([0.0697, 0.9303], abs=1e-3)
    # A seed without a lap has no lap time, and nothing to compare.
    assert found["lap_time_s"]["without"]["mean"] == pytest.approx(8.5)
    assert found["lap_time_s"]["gain"]["mean"] == pytest.approx(2.25)
