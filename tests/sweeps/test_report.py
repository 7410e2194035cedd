import re

import pytest
from optuna.distributions import FloatDistribution

from deepracer_exp.errors import BadInput
from deepracer_exp.reports.tables.evidence import SAME
from deepracer_exp.sweeps.report.best_trial import over_seeds
from deepracer_exp.sweeps.report.page import study_page, study_summary, write_study_page
from deepracer_exp.sweeps.report.wording import short_keys
from deepracer_exp.sweeps.trial import SeedRun, runs_as_json
from tests.browser import needs_chromium
from tests.page_html import Html

from .studies import add, fresh_laps, new_study, season, write_metrics


def test_the_page_is_complete_and_loads_nothing(study, tmp_path):
    path = write_study_page(study, tmp_path / "report.html")
    html = path.read_text(encoding="utf-8")
    page = Html(html)
    assert page.loads == []
    assert "link" not in page.tags[page.tags.index("body") :]
    assert path.stat().st_size < 2_500_000
    assert html.count('id="plotly"') == 1
    for name in ("history", "importance", "slice", "parallel"):
        assert f'data-plot="{name}"' in html
    assert f"Trial {study.best_trial.number} is the best" in page.text
    assert "deepracer-exp train algorithm.lr=" in page.text
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_the_next_steps_name_the_classes_of_the_winner_again(tmp_path):
    study = new_study(tmp_path)
    add(study, [9.5], metrics=3)
    config = tmp_path / study.study_name / "run-0" / "config.yaml"
    config.write_text("network: {target: 'my_network:Net', kwargs: {}}\nstopping: {target: 'my_rule:Rule'}\n")
    page = Html(study_page(study)).text
    assert f"evaluate best:{study.study_name} network.target=my_network:Net --video" in page
    assert f"clone best:{study.study_name} network.target=my_network:Net stopping.target=my_rule:Rule" in page


def test_the_next_steps_say_where_the_runs_are_unless_they_are_in_the_usual_place(tmp_path):
    study = new_study(tmp_path)
    add(study, [9.5], metrics=3)
    name = study.study_name
    assert "runs_dir=" not in study_page(study)
    study.set_user_attr("base", ["seed=1", "runs_dir=else where"])
    page = Html(study_page(study)).text
    assert f"evaluate best:{name} 'runs_dir=else where' --video lap.mp4" in page
    assert f"clone best:{name} 'runs_dir=else where'" in page
    assert f"sweep study={name} 'runs_dir=else where' sweep.trials=" in page


@needs_chromium
def test_a_browser_draws_all_of_it_asks_for_nothing_and_offers_no_upload(study, tmp_path, tab):
    path = write_study_page(study, tmp_path / "report.html")
    tab.open(path)
    tab.draw_all()
    assert tab.evaluate("document.querySelectorAll('[data-state=drawn]').length") == 4
    assert not tab.evaluate("document.body.innerText.includes('WebGL')")
    assert not tab.evaluate(
        "[...document.querySelectorAll('.modebar-btn')].some(b => /share/i.test(b.dataset.title))"
    )
    assert tab.complaints == []
    assert tab.asked_for <= {"file", "data", "blob"}


@pytest.mark.slow
def test_a_page_of_a_thousand_trials_of_many_parameters_stays_under_three_megabytes(tmp_path):
    study = new_study(tmp_path, objectives=["lap_time", "completion"])
    wide = {f"reward.constants.LONG_NAME_{at}": FloatDistribution(0.0, 1.0) for at in range(16)}
    for number in range(1000):
        params = {key: (number * (at + 7) % 1009) / 1009 for at, key in enumerate(wide)}
        values = [9 + number % 97 / 50, 80 + number % 89 / 10]
        add(study, values, params=params, distributions=wide, reason="a reason " * 30)
    write_metrics(tmp_path / "lr_entropy" / "run-0", 250)
    # All of them have the same curve, which saves a thousand files.
    for trial in study.get_trials(deepcopy=False):
        trial.user_attrs["runs"] = runs_as_json(
            [SeedRun(seed=0, run_dir=str(tmp_path / "lr_entropy" / "run-0"))]
        )
    html = study_page(study)
    assert len(html.encode()) < 3_000_000
    assert "The last 700 in this order are left out" in Html(html).text


NASTY = "<script>alert(1)</script>&'\"</script>"


def test_nothing_that_a_study_holds_becomes_part_of_the_page(tmp_path):
    clean, nasty = new_study(tmp_path / "a"), new_study(tmp_path / "b", f"x{NASTY}".replace("/", "|"))
    for study, word in ((clean, "word"), (nasty, NASTY)):
        study.set_user_attr("space", {word: word})
        study.set_user_attr("base", [word])
        study.set_user_attr("protocol", word)
        study.set_user_attr("mlflow_run_id", word)
        for score in (9.0, 10.0):
            add(study, [score], reason=word, overrides=[word], metrics=3)
        add(study, None, "failed", reason=word, traceback=word)
        study.set_user_attr("reranked", [fresh_laps(0, 9.5)])
    assert Html(study_page(nasty)).tags == Html(study_page(clean)).tags
    assert Html(study_page(nasty)).text.count(NASTY) >= 6


def test_the_headline_has_the_steps_of_trials_that_were_pruned_or_failed(tmp_path):
    study = new_study(tmp_path)
    add(study, [9.5], env_steps=750_000)
    add(study, None, "collapsed", env_steps=200_000)
    add(study, None, "failed", env_steps=50_000)
    assert study_summary(study) == [
        "Trial 0 is the best: race score (usual and held-out) 9.50 s on the sweep's laps.",
        "3 of 60 trials ended, 1 of them complete; they drove 1.0 M control steps, 25% of them in trials that were "
        "pruned or failed.",
    ]


def test_a_study_without_a_complete_trial_has_a_page(tmp_path):
    study = new_study(tmp_path)
    assert "No trial is complete" in Html(study_page(study)).text
    add(study, None, "not_learning", seen=80.0)
    page = Html(study_page(study))
    assert "No trial is complete" in page.text
    assert "to paste" not in page.text
    add(study, [75.0], lap_time_s=None, completion=40.0)
    assert "It completed no lap." in study_summary(study)


def test_failures_are_grouped_by_reason_the_most_frequent_first(tmp_path):
    study = new_study(tmp_path)
    for reason in ("rare", "often", "often"):
        add(study, None, "failed", reason=f"{reason} error", traceback=f"Traceback of {reason}")
    text = Html(study_page(study)).text
    found = re.findall(r"(\d) × (\w+) error", text)  # noqa: RUF001
    assert found == [("2", "often"), ("1", "rare")]
    assert text.count("Traceback of often") == 1


def test_the_table_begins_with_the_best_and_ends_with_the_failed(tmp_path):
    study = new_study(tmp_path)
    add(study, None, "failed")
    add(study, [10.0], reason="tenth")
    add(study, None, "median", seen=20.0, reason="pruned one")
    add(study, [9.0], reason="ninth")
    text = Html(study_page(study)).text
    order = [text.rindex(word) for word in ("ninth", "tenth", "pruned one", "failed: for a reason")]
    assert order == sorted(order)


def test_the_winners_on_fresh_laps_have_an_interval_and_the_value_before(tmp_path):
    study = new_study(tmp_path)
    add(study, [9.0])
    add(study, [9.1])
    again = [fresh_laps(0, 9.87, interval=[9.61, 10.23]), fresh_laps(1, 9.3)]
    study.set_user_attr("reranked", again)
    text = Html(study_page(study)).text
    assert "Trial 1 is the best: race score (usual and held-out) 9.30 s on fresh laps." in text
    assert "9.61 s to 10.23 s" in text


def test_a_page_that_cannot_be_written_leaves_the_old_one(study, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("old")
    study = season(tmp_path / "runs", 3)
    study.set_user_attr("objectives", ["theirs"])
    with pytest.raises(BadInput, match="no objectives"):
        write_study_page(study, path)
    assert path.read_text() == "old"


def with_seeds(study, values, **more):
    runs = [SeedRun(seed=seed, status="finished", values=[value]) for seed, value in enumerate(values)]
    return add(study, [sum(values) / len(values)], runs=tuple(runs), **more)


def test_trials_over_seeds_are_held_against_the_best_and_chance_is_called_that(tmp_path):
    study = new_study(tmp_path, seeds=5)
    with_seeds(study, [9.0, 9.1, 9.2, 9.3, 9.4])
    with_seeds(study, [9.1, 9.2, 9.3, 9.4, 9.5])
    with_seeds(study, [12.0, 12.1, 12.2, 12.3, 12.4])
    add(study, [11.0])  # one seed says nothing of the others
    rows = {
        row["trial"]: row
        for row in over_seeds(study, short_keys(["algorithm.lr", "algorithm.entropy_coeff"]))
    }
    assert {number: row["verdict"] for number, row in rows.items()} == {0: "the best", 1: SAME, 2: "worse"}
    assert (rows[0]["seeds"], rows[0]["iqm"], rows[2]["difference"]) == (5, "9.20 s", "3.00 s")
    page = Html(study_page(study))
    assert "Trials over seeds" in page.text
    assert SAME in page.text
    alone = new_study(tmp_path / "alone")
    add(alone, [9.0])
    assert "Trials over seeds" not in Html(study_page(alone)).text
