"""`deepracer-exp analyze`, and the page at the end of a training."""

import re
import shutil
import webbrowser
from functools import partialmethod
from pathlib import Path

import pytest

from deepracer_exp.errors import BadInput
from deepracer_exp.reports.pages import log_report
from deepracer_exp.runs import recording as run_recording
from tests.aws.made_up_logs import drives, log_text
from tests.page_html import Html
from tests.waiting import PATIENCE_S

QUICK = (
    "budget.iterations=1",
    "evaluation.trials=1",
    "evaluation.time_s=2",
    "evaluation.held_out=null",
)
LAPS = ("track=Straight_track", "action_space=deepracer", "reward=progress_delta", "budget.env_steps=16384")


@pytest.fixture
def run_dir(copied) -> Path:
    """A copy of a trained run of one's own, under `runs/tiny/`."""
    return copied(*LAPS)


def findings_told(page: Path) -> str:
    return Html(page.read_text(encoding="utf-8")).text


def test_a_run_is_analysed_into_its_folder_and_the_terminal_reports_what_stands_on_the_page(run_dir, call):
    ended = call("analyze", str(run_dir))
    assert ended.code == 0, ended.stderr
    assert f"page  {run_dir / 'report.html'}" in ended.stdout
    text = findings_told(run_dir / "report.html")
    assert "16,384 control steps" in text
    printed = [line[5:] for line in ended.stdout.splitlines() if re.match(r"  \d  ", line)]
    assert len(printed) >= 3
    assert all(" ".join(line.split()) in text for line in printed)
    page = (run_dir / "report.html").read_text()
    assert 'id="figure-reward_terms"' in page
    assert "<h1>tiny</h1>" in page
    # The result of the evaluation and the lap that it drove stand before all that exploration did.
    shown = [
        text.index(words) for words in ("on other conditions", "The fastest lap found of this car", "16,384")
    ]
    assert shown == sorted(shown)
    first, *_ = re.findall(r'id="figure-(\w+)"', page)
    assert first == "evaluated_lap"
    assert f"<title>tiny: {run_dir.name}</title>" in page


@pytest.mark.parametrize("what", ["{name}", "tiny/{name}", "{begin}", "best:tiny"])
def test_runs_are_found_as_by_other_commands(run_dir, call, monkeypatch, what):
    found: list[Path] = []

    def stop(place: Path) -> None:
        found.append(place)
        raise BadInput("found")

    monkeypatch.setattr(run_recording, "read_log", stop)
    ended = call("analyze", what.format(name=run_dir.name, begin=run_dir.name[:11]))
    assert [(ended.cwd / place).resolve() for place in found] == [run_dir.resolve()]


def test_logs_from_elsewhere_have_their_page_in_the_current_folder(call, tmp_path):
    (tmp_path / "from aws").mkdir()
    (tmp_path / "from aws" / "training-robomaker.log").write_text(log_text(drives([0, 1])))
    ended = call("analyze", "from aws")
    assert ended.code == 0, ended.stderr
    assert "from-aws-analysis.html" in ended.stdout
    assert "control steps" in findings_told(tmp_path / "from-aws-analysis.html")


def test_several_trainings_in_a_folder_are_named(call, tmp_path):
    (tmp_path / "both").mkdir()
    for seed, name in enumerate("ab"):
        log = log_text(drives([0, 1], seed=seed))
        (tmp_path / "both" / f"worker_0-{name}.log").write_text(log)
    ended = call("analyze", "both")
    assert ended.code == 0, ended.stderr
    (line,) = [line for line in ended.stdout.splitlines() if "trainings in it: 2" in line]
    assert re.search(r"worker_#-a from iteration 0, .*worker_#-b from iteration 1\.", line)
    assert "Trainings in it" in (tmp_path / "both-analysis.html").read_text()
    (tmp_path / "both" / "worker_0-b.log").unlink()
    assert "trainings in it" not in call("analyze", "both").stdout


def test_another_reward_function_is_replayed_a_target_has_its_chance_and_the_page_is_opened(
    run_dir, call, tmp_path, monkeypatch
):
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    (tmp_path / "mine.py").write_text("def reward_function(params):\n    return float(params['speed'])\n")
    asked = ("--reward", "mine.py", "--target", "1000", "--open", "--output", "page.html")
    ended = call("analyze", str(run_dir), *asked)
    assert ended.code == 0, ended.stderr
    assert "mine" in ended.stdout
    assert "1000.00 s" in ended.stdout
    assert "Under another reward function" in findings_told(tmp_path / "page.html")
    assert opened == [(tmp_path / "page.html").resolve().as_uri()]


def test_code_from_elsewhere_is_not_run(run_dir, call, tmp_path):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "training-robomaker.log").write_text(log_text(drives([0, 1])))
    trap = f"open({str(tmp_path / 'trapped')!r}, 'w')\ndef terms(params): return {{}}\n"
    (tmp_path / "theirs" / "reward_function.py").write_text(trap)
    shutil.copytree(run_dir, tmp_path / "their_run")
    (tmp_path / "their_run" / "reward_function.py").write_text(trap)
    assert call("analyze", "theirs").code == 0
    assert call("analyze", "their_run").code == 0
    assert not (tmp_path / "trapped").exists()


@pytest.mark.parametrize(
    ("asked", "has_page"), [((), False), (("-o", "page.html"), True), (("--target", "9"), True)]
)
def test_laps_are_written_without_the_page_unless_that_is_asked_for_too(
    run_dir, call, tmp_path, monkeypatch, asked, has_page
):
    monkeypatch.setattr(log_report, "html", lambda page: page.view.name)  # drawing one takes a second
    pages = [run_dir / "report.html", tmp_path / "page.html"]
    pages[0].unlink(missing_ok=True)
    ended = call("analyze", str(run_dir), "--replay", "laps.html", *asked)
    assert ended.code == 0, ended.stderr
    assert "16,384 control steps of training" in ended.stdout
    assert ended.stdout.splitlines()[-1] == "  laps  laps.html"
    assert "an ordinary lap" in (tmp_path / "laps.html").read_text()
    assert any(page.exists() for page in pages) == has_page
    assert ("  page  " in ended.stdout) == has_page


def test_the_lap_whose_line_is_written_is_named_and_can_be_asked_for(run_dir, call, tmp_path):
    ended = call("analyze", str(run_dir), "--line", "line.py")
    assert ended.code == 0, ended.stderr
    match = re.fullmatch(
        r"  line  line\.py \(the fastest lap, iteration \d+, episode (\d+), \d\.\d{3} s\)",
        ended.stdout.splitlines()[-1],
    )
    assert match
    assert call("analyze", str(run_dir), "--line", "same.py", "--lap", match[1]).code == 0
    assert (tmp_path / "same.py").read_text() == (tmp_path / "line.py").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["empty"], ["empty"]),
        (["text.txt"], ["text.txt"]),
        (["RUN", "--target", "-3"], ["--target -3", "accepted"]),
        (["RUN", "--target", "nan"], ["--target nan", "accepted"]),
        (["RUN", "--reward", "racing_lime"], ["racing_lime"]),
        (["RUN", "--track", "Atlantis"], ["Atlantis"]),
        (["RUN", "other"], ["2 runs or logs given", "deepracer-exp compare takes several"]),
        (["RUN", "--line", "line.txt"], ["--line line.txt", "accepted", ".csv, .npy, .py"]),
        (["RUN", "--line", "nowhere/line.csv"], ["--line nowhere/line.csv", "accepted"]),
        (["RUN", "--line", "line.csv", "--lap", "99999"], ["--lap 99999", "accepted", "fastest"]),
        (["RUN", "--line", "line.csv", "--lap", "best"], ["--lap best", "accepted"]),
        (["RUN", "--lap", "3"], ["--lap 3", "beside --line"]),
    ],
)
def test_bad_input_is_one_line(run_dir, call, tmp_path, arguments, words):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.txt").write_text("hello\n")
    ended = call("analyze", *(str(run_dir) if word == "RUN" else word for word in arguments))
    ended.assert_refused(*words)
    assert not [*tmp_path.glob("*.html"), *tmp_path.glob("line.*")]


@pytest.mark.processes
def test_a_training_ends_with_its_page_which_stands_in_its_mlflow_run_too(call, monkeypatch):
    from mlflow import MlflowClient

    from deepracer_exp.runs.run_files import read_run_id
    from deepracer_exp.tracking.tracker import ProjectedTracker

    patient = partialmethod(ProjectedTracker.finish, deadline_s=PATIENCE_S)
    monkeypatch.setattr(ProjectedTracker, "finish", patient)

    tiny = ("experiment=tiny", "collector=in_process", "collector.threads=1", *QUICK)
    ended = call("train", *tiny, "report=true")
    assert ended.code == 0, ended.stderr
    assert "report.html" in ended.stdout
    line = r" analyze \S+ --open"
    assert re.search(rf"{line} +# open its report|open its report\n.*{line}\n", ended.stdout)
    assert "1,024 control steps" in findings_told(ended.folder / "report.html")
    client = MlflowClient(tracking_uri=f"sqlite:///{ended.cwd / 'runs' / 'mlflow.db'}")
    found = {file.path for file in client.list_artifacts(read_run_id(ended.folder) or "")}
    assert {"report.html", "learning.png"} <= found


def test_a_fault_of_the_page_is_reported_and_leaves_the_training_finished(train_here, monkeypatch):
    def fault(*_):
        raise ZeroDivisionError("a bug\nof two lines")

    monkeypatch.setattr(log_report, "write_log_page", fault)
    ended = train_here("report=true", *QUICK)
    assert ended.code == 0
    assert ended.summary["status"] == "finished"
    (line,) = [line for line in ended.stderr.splitlines() if line.startswith("warning: ")]
    assert "report.html could not be written: ZeroDivisionError: a bug of two lines" in line
    assert "Traceback" not in ended.stderr
    log = (ended.folder / "log.txt").read_text()
    assert "Traceback" in log
    assert "ZeroDivisionError: a bug" in log
    assert not (ended.folder / "report.html").exists()


def test_a_second_signal_during_the_page_leaves_it_off_and_the_training_finished(train_here, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(log_report, "write_log_page", interrupted)
    ended = train_here("report=true", *QUICK)
    assert (ended.code, ended.summary["status"]) == (0, "finished")
    assert "report.html was left off; `deepracer-exp analyze " in ended.stderr


def test_without_report_there_is_none(trained):
    assert not (trained(*LAPS).folder / "report.html").exists()
