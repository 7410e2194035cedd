"""Which checkpoint an evaluation of the service judges, and what names it."""

import json
from pathlib import Path

import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.reports.findings import findings
from deepracer_exp.reports.tables.log_tables import facts
from deepracer_exp.reports.tables.log_view import prepare

from . import made_up_logs as made


def model(tmp_path: Path, last: str, best: str) -> Path:
    """Write the traces of three iterations of 12 control steps beside the names of a model's checkpoints."""
    files = made.training_csvs("training-simtrace", iterations=3)
    names = {"best_checkpoint": {"name": f"{best}.ckpt"}, "last_checkpoint": {"name": f"{last}.ckpt"}}
    files["model/deepracer_checkpoints.json"] = json.dumps(names)
    return made.write_folder(files, tmp_path)


def test_an_evaluation_judges_the_policy_that_drove_the_iteration_before_it(reference):
    view = prepare(read_recording(reference / "inputs/fourth/02-evaluated-checkpoint"))
    (found,) = (finding for finding in findings(view) if finding.rule == "submit")
    assert (
        "Submit the checkpoint 1_Step-265, which drove iteration 1: its evaluation completed all 3"
        in found.sentence
    )
    assert found.sentence.endswith("After it: 2_Step-530 (11.00 s, 33%).")


@pytest.mark.parametrize(
    ("last", "expected"),
    [
        ("3_Step-36", {0: "0_Step-0", 1: "1_Step-12", 2: "2_Step-24", 3: "3_Step-36"}),
        ("52_Step-24", {0: "50_Step-0", 1: "51_Step-12", 2: "52_Step-24", 3: "53_Step-36"}),
        ("52_Step-25", {}),
    ],
)
def test_the_last_checkpoint_of_the_folder_says_how_the_others_are_numbered(tmp_path, last, expected):
    recording = read_recording(model(tmp_path, last, "1_Step-12"))
    assert recording.checkpoints == expected
    assert not recording.checkpoints_counted
    assert not recording.problems
    words = dict(facts(prepare(recording)))["Checkpoints in the model's folder"]
    assert words == f"1_Step-12, the best by the service's evaluations; {last}, the last"


def test_a_name_that_is_counted_alone_is_called_that(tmp_path):
    recording = read_recording(
        made.write_folder(made.training_csvs("training-simtrace", iterations=3), tmp_path)
    )
    assert recording.checkpoints[1] == "1_Step-12"
    assert recording.checkpoints_counted
    sentence = next(finding.sentence for finding in findings(prepare(recording)) if finding.rule == "submit")
    assert "(no file names it: counted as if the training were no clone)" in sentence


def test_a_file_without_names_of_checkpoints_is_a_problem(tmp_path):
    folder = model(tmp_path, "the newest", "1_Step-12")
    (problem,) = read_recording(folder).problems
    assert problem.file.endswith("deepracer_checkpoints.json")
    assert "'the newest.ckpt' is no name of a checkpoint; accepted: 25_Step-33002.ckpt" in problem.reason
