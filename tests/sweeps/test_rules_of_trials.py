"""The stopping rules with which trials train."""

from dataclasses import replace

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.sweep import compose_sweep
from sweeps.sweep import _without_rules

LR = "algorithm.lr=0.1,0.2"
MEDIAN = "sweep.pruners=[median]"


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["study=s", LR], []),
        (["study=s", LR, MEDIAN], ["stopping=none"]),
        (["study=s", LR, MEDIAN, "stopping=plateau"], ["stopping=plateau"]),
        (["study=s", LR, MEDIAN, "stopping=entropy,none"], []),
        (["sweep=lr_entropy"], ["stopping=impatient"]),
        (["sweep=lr_entropy", MEDIAN], ["stopping=none"]),
        (["sweep=lr_entropy", MEDIAN, "stopping=impatient"], ["stopping=impatient"]),
        (
            ["sweep=lr_entropy", "stopping.converged.patience=50"],
            ["stopping=impatient", "stopping.converged.patience=50"],
        ),
    ],
)
def test_trials_have_a_stopping_rule_if_the_pruner_entropy_or_a_rule_is_asked_for(overrides, expected):
    base = _without_rules(compose_sweep(overrides), overrides).base
    assert [line for line in base if line.startswith("stopping")] == expected


def test_a_file_that_chooses_rule_and_pruners_keeps_both(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf/sweep").mkdir(parents=True)
    (tmp_path / "conf/sweep/mine.yaml").write_text(
        "defaults: [own, _self_]\ntrain: [stopping=plateau]\npruners: [median]\nspace: {algorithm.lr: '0.1,0.2'}\n"
    )
    assert "stopping=plateau" in _without_rules(compose_sweep(["sweep=mine"]), ["sweep=mine"]).base


def test_impatient_is_entropy_that_decides_sooner_that_a_run_has_converged():
    patient, impatient = (
        compose_experiment([f"stopping={one}"])[0].stopping for one in ("entropy", "impatient")
    )
    assert impatient.converged.warmup < patient.converged.warmup
    converged = replace(
        patient.converged,
        warmup=impatient.converged.warmup,
        patience=impatient.converged.patience,
        best_patience=impatient.converged.best_patience,
    )
    assert impatient == replace(patient, converged=converged)
