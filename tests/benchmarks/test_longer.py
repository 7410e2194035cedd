"""The benchmark of long trainings reads its figures from the runs of several seeds."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import longer
from benchmarks.fresh import Driven
from deepracer_exp.reports.tables.evidence import estimate


def test_each_seed_of_each_group_is_trained_once_and_laps_are_held_against_the_bound(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    trained: Callable[..., Any],
) -> None:
    seconds = ([None, 9.0, 8.0], [10.0, 9.5, 8.5], [11.0, 9.2, 9.0], [9.0, 9.1, None])
    (row,) = trained("budget.iterations=1").metrics
    asked = []

    def run(folder: Path, overrides: list[str]) -> Path:
        """Return a run with other laps than it drove, as the benchmark would find it."""
        asked.append((folder.name, overrides))
        seed = int(folder.name[-1])
        place = folder / "runs" / "a" / "run"
        place.mkdir(parents=True)
        rows = [
            row
            | {"env_steps": steps, "eval_completion": 90.0, "eval_lap_share": 0.5, "eval_lap_time_s": lap_s}
            | {"held_out_completion": 60.0 + 10 * seed}
            for steps, lap_s in zip((500_000, 1_400_000, 1_600_000), seconds[seed], strict=True)
        ]
        lines = [rows[0], row | {"env_steps": 900_000, "eval_completion": None}, *rows[1:]]
        (place / "metrics.jsonl").write_text("".join(json.dumps(one) + "\n" for one in lines))
        return place

    monkeypatch.setattr(longer, "trained", run)

    def drive(folder: Path, checkpoints: list[str]) -> list[Driven]:
        """Return fresh laps of the best checkpoint: the last seed has none."""
        assert checkpoints == ["best"]
        seed = int(folder.parents[2].name[-1])
        lap_s = None if seed == 3 else 8.0 + seed
        return [
            Driven(
                completion=99.0,
                lap_share=0.9,
                lap_time_s=lap_s,
                held_out_completion=90.0 + seed,
                held_out_lap_time_s=lap_s,
            )
        ]

    monkeypatch.setattr(longer, "drive", drive)
    monkeypatch.setattr(longer, "lap_bound_s", lambda _: 8.0)  # takes seconds
    file = tmp_path / "longer.json"
    words = ["--seeds", "4", "--tracks", "reinvent_base", "--runs-dir", str(tmp_path), "--json", str(file)]
    assert longer.main([*words, "--recipes", "fast_lap", "--jobs", "1"]) == 0
    assert [name for name, _ in asked] == [f"reinvent_base-fast_lap-{seed}" for seed in range(4)]
    assert {"experiment=fast_lap", "stopping=none", "collector=in_process", "seed=0"} <= set(asked[0][1])
    figures = json.loads(file.read_text())["tracks"]["reinvent_base"]["fast_lap"]
    assert figures["steps"] == [500_000, 1_400_000, 1_600_000]
    # Of four a quarter is left out at either end: the seed without a lap is the slowest.
    assert figures["laps_s"] == [10.5, 9.15, 8.75]
    low, high = estimate([np.array([9.0, 9.5, 9.2, 9.1])]).interval
    assert figures["interval_s"][1] == pytest.approx([low, high], abs=1e-4)
    assert figures["worst_rise"] == pytest.approx(8.75 / 9.15 - 1, abs=1e-4)
    assert figures["over_bound"] == pytest.approx(9.15 / 8 - 1, abs=1e-4)
    assert figures["over_bound_end"] == pytest.approx(8.75 / 8 - 1, abs=1e-4)
    assert figures["held_out"] == [75.0, 75.0, 75.0]
    assert (figures["best"]["lap_s"], figures["best"]["held_out"]) == (9.5, 91.5)
    assert "`reinvent_base`, fast_lap" in capsys.readouterr().out
