"""The benchmark of the physical car trains what it says and drives it under each of the car's parts."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks import real_car
from deepracer_exp.commands.export.car_converter import has_openvino
from tests.commands.export.test_car_archive import SHORT
from tests.conftest import Ended


def test_each_seed_is_trained_whole_and_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def train(folder: Path, overrides: list[str]) -> Path:
        asked.append((folder.name, *overrides[-2:]))
        return folder

    figures = ["steps", "train_s", "zigzag_simulator", "zigzag_car"]
    figures += [f"{what}_{name}" for what in ("laps", "lap_s") for name in real_car.protocols()]

    def measured(run: Path, frames: object) -> dict[str, float | None]:
        assert frames is None
        return {**dict.fromkeys(figures, 120.0), "laps_car": 0.8, "lap_s_car": [8.0, None][int(run.name[-1])]}

    monkeypatch.setattr(real_car, "trained", train)
    monkeypatch.setattr(real_car, "measure", measured)
    file = tmp_path / "real_car.json"
    words = [
        "--seeds",
        "2",
        "--first-seed",
        "0",
        "--tracks",
        "Oval_track",
        "--without",
        "car",
        "network=shallow",
    ]
    assert real_car.main([*words, "--runs-dir", str(tmp_path), "--json", str(file)]) == 0
    assert asked == [
        (f"Oval_track-{name}-{seed}", "network=shallow", f"seed={seed}")
        for name in ("whole", "car")
        for seed in (0, 1)
    ]
    whole, without = json.loads(file.read_text())["trainings"]
    assert (whole["track"], whole["without"], without["without"]) == ("Oval_track", None, "car")
    assert whole["laps_car"]["iqm"] == 0.8
    assert whole["lap_s_car"]["seeds"] == [8.0, None]
    out = capsys.readouterr().out
    assert "| Oval_track, nothing |" in out
    assert "95% (simulator), 90% (sim2real), 90% (car)" in out


def test_a_run_is_measured_under_each_condition(
    monkeypatch: pytest.MonkeyPatch, trained: Callable[..., Ended]
) -> None:
    run = trained(*SHORT).folder
    asked = real_car.protocols()
    shorter = {name: replace(config, time_s=0.5, trials=1) for name, config in asked.items()}
    monkeypatch.setattr(real_car, "protocols", lambda: shorter)
    seeded = torch.Generator().manual_seed(0)
    noise = torch.randint(0, 256, (5, 1, 120, 160), dtype=torch.uint8, generator=seeded)
    frames = noise if has_openvino() else None
    found = real_car.measure(run, frames)
    assert found["steps"] == 64
    assert {name for name in found if name.startswith("laps_")} == {f"laps_{name}" for name in asked}
    assert all(found[f"laps_{name}"] == 0.0 for name in asked if found[f"laps_{name}"] is not None)
    assert {"zigzag_simulator", "zigzag_car"} <= set(found)
    if frames is not None:
        assert found["openvino_same"] == 1.0
        assert found["openvino_difference"] < 0.01
