import dataclasses
import re
from html import escape, unescape
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.aws.logs.recorded import LogProblem, Recording
from deepracer_exp.errors import BadInput
from deepracer_exp.reports.charts.driving_line import raced_lap
from deepracer_exp.reports.charts.reward_charts import replayed_charts
from deepracer_exp.reports.finding import FIGURES
from deepracer_exp.reports.findings import findings
from deepracer_exp.reports.pages.log_report import SECTIONS, LogPage, write_log_page
from deepracer_exp.reports.pages.log_report import html as page_html
from deepracer_exp.reports.tables.log_tables import (
    MOST_ITERATIONS,
    facts,
    headline,
    iteration_rows,
    result_in_words,
)
from deepracer_exp.reports.tables.log_view import LogView, prepare
from deepracer_exp.reports.tables.reward_replay import ReplayedRewards
from deepracer_exp.runs.recording import RunRecording
from deepracer_exp.runs.run_result import RunResult
from tests.page_html import Html
from tests.reports.tables.made_up import Drive, made_up_recording

NASTY = "</script><script>alert(1)</script><img src=x onerror=alert(2)>&'\"{{7*7}}"


def write_report(log: Recording | RunRecording, path: Path) -> Path:
    view = prepare(log)
    return write_log_page(path, LogPage(view, findings(view)))


def season(iterations: int = 12, **changes: object) -> Recording:
    """A training that learns: it runs off in its first iterations, and gets faster."""
    drives = []
    for at in range(iterations):
        drives += [
            Drive(iteration=at, speed_mps=1.2 + 0.05 * at + 0.02 * k, offset_m=0.05 * k) for k in range(3)
        ]
        drives += [Drive(iteration=at, speed_mps=2.0, off_at=40 + at % 3, wanders=((0.1, 0.3),))]
    entropy = np.linspace(2.4, 0.6, iterations).tolist()
    evaluations = {"race": [Drive(speed_mps=2.0, offset_m=0.1 * k) for k in range(3)]}
    recording = made_up_recording(drives, entropy=entropy, evaluations=evaluations)
    return dataclasses.replace(recording, **changes)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return season()


@pytest.fixture(scope="module")
def view(recording) -> LogView:
    return prepare(recording)


@pytest.fixture(scope="module")
def path(recording, tmp_path_factory) -> Path:
    return write_report(recording, tmp_path_factory.mktemp("page") / "report.html")


@pytest.fixture(scope="module")
def html(path) -> str:
    return path.read_text(encoding="utf-8")


def test_the_page_begins_with_outcome_and_findings_and_each_leads_to_a_figure_that_is_there(html, view):
    read = Html(html)
    found = findings(view)
    order = [read.text.rindex(" ".join(one.sentence.split())) for one in found]
    assert order == sorted(order)
    assert [name for name in read.ids if not name.startswith("figure")][:2] == ["outcome", "findings"]
    assert order[-1] < read.text.rindex("Candidates for submission")
    assert set(read.links) <= set(read.ids)
    assert {f"figure-{one.figure}" for one in found} <= set(read.ids)


def test_the_first_screen_is_what_was_raced_and_exploration_comes_below(html, view):
    read = Html(html)
    result = result_in_words(view)
    times_s = view.evaluation_episodes["lap_time_s"]
    assert result == f"Laps in {times_s.mean():.2f} s, 3 of 3 in its evaluations and races."
    assert read.text.rindex(result) < read.text.rindex("Findings") < read.text.rindex(headline(view))
    assert next(name for name in read.ids if name.startswith("figure")) == "figure-evaluated_lap"
    lap = raced_lap(view)
    assert lap.title == f"The fastest evaluated lap: {times_s.min():.2f} s"
    assert "A lap of race." in read.text
    (dots,) = (layer for layer in lap.rows[0][0].layers if layer.get("mode") == "markers")
    assert len(dots["x"]) == pytest.approx(15 * times_s.min(), abs=2)
    # A race without a training has its own laps as laps.
    assert raced_lap(prepare(made_up_recording([], evaluations={"race": [Drive()]}))) is None


def test_a_log_of_the_service_is_advised_by_its_first_finding(view, html):
    assert f"<p>{escape(findings(view)[0].sentence)}</p>" in " ".join(html.split())


def test_the_page_is_small_loads_nothing_and_has_words_and_tables_without_scripts(path, html, view):
    read = Html(html)
    assert path.stat().st_size < 5_000_000
    assert read.loads == []
    assert "default-src 'none'" in unescape(html)
    own = re.sub(r'(?s)<script type="text/plain".*?</script>', "", html)
    assert not re.search(r"https?://|url\(|@import", own)
    assert [file.name for file in path.parent.iterdir()] == ["report.html"]
    titles = (
        "The fastest exploring laps",
        "Candidates for submission",
        "Iterations",
        "Setup",
        "Files",
    )
    heads = ("Lap time, s", "25th percentile, s", "Entropy, nats")
    assert [words for words in (headline(view), *titles, *heads) if words not in read.text] == []
    assert read.text.count("figures need JavaScript") == html.count("data-plot=")


def test_a_recording_gives_the_same_page_again(recording, html, tmp_path):
    assert write_report(recording, tmp_path / "again.html").read_text(encoding="utf-8") == html


def nasty(recording: Recording, word: str) -> Recording:
    steps = recording.steps.copy()
    steps["stream"] = steps["stream"].cat.rename_categories({"race": f"race {word}"})
    steps["episode_status"] = steps["episode_status"].cat.rename_categories(
        {"off_track": f"off_track {word}"}
    )
    steps["track"] = steps["track"].cat.rename_categories({"reinvent_base": f"course {word}"})
    return dataclasses.replace(
        recording,
        name=f"name {word}",
        steps=steps,
        track=f"course {word}",
        hyperparameters={f"key {word}": word, "discount_factor": 0.99},
        reward_source=f"# {word}",
        problems=(LogProblem(f"file {word}", 3, f"reason {word}"),),
        files=(Path(f"file {word}".replace("/", "|")),),
    )


def test_nothing_that_a_log_holds_becomes_part_of_the_page(recording):
    pages = []
    for word in ("word", NASTY):
        view = prepare(nasty(recording, word))
        pages.append(Html(page_html(LogPage(view, findings(view)))))
    clean, dirty = pages
    assert dirty.tags == clean.tags
    assert dirty.ids == clean.ids
    assert dirty.loads == []
    for what in ("name", "key", "#", "reason", "file"):
        assert f"{what} {NASTY}" in dirty.text


@pytest.mark.parametrize(
    ("recording", "words"),
    [
        (made_up_recording([Drive(until=0.004)]), "Findings"),
        (made_up_recording([Drive()]), "1 complete lap"),
        (made_up_recording([Drive(off_at=30), Drive(off_at=31)]), "no complete lap"),
        (made_up_recording([], evaluations={"race": [Drive(), Drive(speed_mps=1.6)]}), "No training;"),
    ],
    ids=["two rows", "one lap", "never a lap", "evaluations alone"],
)
def test_a_log_with_little_in_it_has_a_page(recording, words, tmp_path):
    assert words in Html(write_report(recording, tmp_path / "page.html").read_text()).text


def test_an_unknown_course_has_a_page_without_maps(tmp_path):
    steps = season(3).steps
    steps = steps.assign(X=steps["X"] * 7 + 100, track_len=steps["track_len"] * 3)
    steps["track"] = steps["track"].cat.rename_categories({"reinvent_base": "my own"})
    text = Html(write_report(season(3, steps=steps, track="my own"), tmp_path / "page.html").read_text()).text
    assert "Unreadable parts" in text
    assert "my own" in text


def test_a_recording_without_a_step_has_no_page_and_the_old_one_stays(tmp_path):
    old = tmp_path / "page.html"
    old.write_text("old")
    with pytest.raises(BadInput, match="no control steps"):
        write_report(season(1, steps=season(1).steps.iloc[:0]), old)
    assert old.read_text() == "old"


def test_the_sensors_of_a_log_are_named_but_no_default_ones_of_a_run_of_ours(view):
    best = RunResult(measure="race_score", rank=(0.0, 0.0), iteration=10, completion=90.0, lap_time_s=None)
    own = dataclasses.replace(view, run=RunRecording(recording=view.recording, best=best))
    spaces = [dict(facts(one))["Action space"] for one in (view, own)]
    assert spaces[0] == f"{spaces[1]}; sensors FRONT_FACING_CAMERA"


def test_of_very_many_iterations_the_table_has_every_second_or_third_and_the_last():
    drives = [Drive(iteration=at, until=0.01) for at in range(2 * MOST_ITERATIONS + 5)]
    view = prepare(made_up_recording(drives))
    table = iteration_rows(view)
    assert len(table.rows) <= MOST_ITERATIONS
    assert table.left_out == len(drives) - len(table.rows)
    assert table.rows[-1][0] == str(len(drives) - 1)


LAPS = pd.DataFrame(
    {
        "stream": "training",
        "iteration": [0, 1, 2],
        "episode": [0, 4, 8],
        "time_s": [10.0, 11.0, 12.0],
        "reward": [1.0, 2.0, 3.0],
        "new_reward": [30.0, 20.0, 10.0],
        "rank": [3, 2, 1],
        "new_rank": [1, 2, 3],
        "time_rank": [1, 2, 3],
    }
)
"""The new reward turns the order of the laps round."""
WAYPOINTS = pd.DataFrame(
    {
        "reversed": False,
        "closest_waypoint": [0, 10, 20],
        "visits": [9, 9, 9],
        "reward": [0.0, 1.0, 2.0],
        "new_reward": [2.0, 1.0, 0.0],
        "share": [0.0, 0.5, 1.0],
        "new_share": [1.0, 0.5, 0.0],
    }
)


def test_another_reward_is_reported_with_the_ranks_of_laps_and_places(view):
    replayed = ReplayedRewards(
        reward="mine", course=view.course, steps=view.steps, laps=LAPS, waypoints=WAYPOINTS
    )
    assert replayed.sentences[0] == (
        "Of 3 complete laps mine would have rewarded the one of episode 0 most (10.00 s, 1st by time, 3rd by the "
        "recorded reward); the fastest lap (10.00 s) is 1st instead of 3rd."
    )
    assert "mine -1.00, recorded reward 1.00; between both rewards -1.00" in replayed.sentences[1]
    assert "waypoint 0 gains most and waypoint 20 loses most" in replayed.sentences[2]
    assert replayed.best_laps.rows[0][:3] == ("1", "3", "1")
    assert [chart.name for chart in replayed_charts(replayed)] == ["replayed_laps", "replayed_places"]
    text = Html(page_html(LogPage(view, findings(view), replay=replayed))).text
    assert text.index(replayed.sentences[0]) < text.rindex("The fastest exploring laps")


def test_the_gallery_lists_every_figure_of_the_page_and_every_finding_names_one_of_them():
    gallery = (Path(__file__).parents[2] / "docs" / "gallery.md").read_text(encoding="utf-8")
    names = {chart.__name__ for some in SECTIONS.values() for chart in some}
    assert [name for name in names if f"`{name}`" not in gallery] == []
    assert set(FIGURES.values()) <= names
