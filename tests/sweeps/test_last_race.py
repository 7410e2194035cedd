"""What a study says of its last race: which policy to submit, and why."""

from deepracer_exp.runs.best_run import read_best_of_sweep
from deepracer_exp.sweeps.report.last_race import LastRace, Racer, last_race, store_last_race, write_submitted
from deepracer_exp.sweeps.report.page import export_step, study_page, study_summary
from tests.page_html import Html

from .studies import add, new_study


def racer(trial, score_s, run, *, is_clone=False, half=0.1, held_out=90.0):
    return Racer(
        trial=trial, is_clone=is_clone, run=run, checkpoint="000040", race_score_s=score_s,
        interval=[score_s - half, score_s + half], lap_time_s=score_s - 1, laps_percent=100.0, completion=100.0,
        held_out_laps_percent=held_out, held_out_completion=held_out,
    )  # fmt: skip


def raced(study, clone_s, half=0.1, held_out=90.0):
    """Let the clone of trial 1 race, in this many seconds, against trials 1 and 0."""
    racers = (
        racer(1, 9.0, "run-1", half=half, held_out=held_out),
        racer(0, 9.5, "run-0", half=half, held_out=held_out),
        racer(1, clone_s, "run-1-clone1", is_clone=True, half=half, held_out=held_out),
    )
    store_last_race(study, LastRace(laps=60, cloned_with="randomization=sim2real", racers=racers))
    race = last_race(study)
    assert race is not None
    return race


def two_trials(tmp_path):
    study = new_study(tmp_path)
    add(study, [9.4])
    add(study, [9.1], metrics=3)
    return study


def test_the_lowest_race_score_of_all_conditions_is_submitted_whoever_drove_it(tmp_path):
    study = two_trials(tmp_path)
    verdict = raced(study, 8.5).verdict()
    assert verdict == (
        "Submit the clone of trial 1: its race score (usual and held-out) on fresh laps is 8.50 s, against 9.00 s of "
        "trial 1 and 9.50 s of trial 0."
    )
    assert study_summary(study)[0] == verdict
    slower = raced(study, 9.7)
    assert [one.run for one in slower.racers] == ["run-1", "run-0", "run-1-clone1"]
    assert slower.verdict().startswith("Submit trial 1: ")
    write_submitted(study, tmp_path, slower)
    best = read_best_of_sweep(tmp_path / study.study_name)
    assert best is not None
    assert (best.trial, best.run_dir, best.values) == (1, "run-1", {"race_score": 9.0})


def test_scores_with_overlapping_intervals_are_said_to_be_chance(tmp_path):
    study = two_trials(tmp_path)
    assert raced(study, 8.5).doubt() == ""
    doubt = raced(study, 8.9).doubt()
    assert doubt == "Its interval overlaps that of trial 1: chance may decide between them."
    assert study_summary(study)[1] == doubt
    assert "overlaps those of trial 1 and trial 0" in raced(study, 8.9, half=1.0).doubt()


def test_without_held_out_laps_the_rule_speaks_of_the_usual_ones(tmp_path):
    race = raced(two_trials(tmp_path), 8.5, held_out=None)
    assert race.rule().startswith("the lowest race score (usual), the seconds per complete lap, failed laps")
    assert "held-out" not in race.verdict()


def test_trials_made_since_the_last_race_were_not_in_it(tmp_path):
    study = two_trials(tmp_path)
    raced(study, 8.5)
    add(study, [7.0])
    assert last_race(study) is None
    assert "Submit" not in " ".join(study_summary(study))
    assert "What to submit" not in Html(study_page(study)).text


def test_the_page_says_what_to_submit_why_and_how(tmp_path):
    study = two_trials(tmp_path)
    raced(study, 8.5)
    page = Html(study_page(study))
    assert "What to submit, and why" in page.text
    text = " ".join(page.text.split())
    assert "Submit run run-1-clone1 , checkpoint 40, which best:lr_entropy means from now on" in text
    assert "deepracer-exp export best:lr_entropy format=aws" in page.text
    assert (
        "seconds per complete lap of both conditions together, failed laps included, on 60 laps" in page.text
    )
    assert "Tried: entropy_coeff, lr." in page.text
    for cell in ("The clone of trial 1", "8.50 s", "8.40 s to 8.60 s", "90.0%"):
        assert cell in page.text
    config = tmp_path / study.study_name / "run-1-clone1" / "config.yaml"
    config.parent.mkdir()
    config.write_text("observation: {camera: {width: 160}}\n")
    assert "format=aws-model" in export_step(study)[0]
