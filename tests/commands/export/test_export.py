"""The command, on a real run."""

import pytest


def test_onnx_goes_into_the_runs_folder_and_is_checked(trained, call):
    run = trained()
    ended = call("export", str(run.folder), "format=onnx", "checkpoint=last")
    assert ended.code == 0, ended.stderr
    assert ended.stdout.splitlines()[0] == str(run.folder / "export" / "policy.onnx")
    assert (run.folder / "export" / "policy.onnx").stat().st_size > 10_000
    assert "checkpoint   4" in ended.stdout
    assert "on 1,000 observations" in ended.stdout


def test_aws_files_go_to_the_given_folder_with_notes_on_changes(trained, call):
    run = trained("reward.constants.PROGRESS_WEIGHT=2.5", "algorithm.batch_size=1000", "budget.iterations=1")
    ended = call("export", str(run.folder), "format=aws", "-o", "custom_files")
    assert ended.code == 0, ended.stderr
    names = sorted(path.name for path in (ended.cwd / "custom_files").iterdir())
    assert names == ["hyperparameters.json", "model_metadata.json", "reward_function.py"]
    assert "PROGRESS_WEIGHT = 2.5" in (ended.cwd / "custom_files" / "reward_function.py").read_text()
    assert "batch_size=512, the nearest to 1000 that the AWS console accepts" in ended.stdout


def test_what_the_console_would_refuse_of_a_reward_is_reported(trained, call, tmp_path):
    reward = tmp_path / "mine.py"
    reward.write_text("import os\n\n\ndef reward_function(params):\n    return 1.0\n")
    run = trained(f"reward.file={reward}", "budget.iterations=1")
    ended = call("export", str(run.folder), "format=aws", "-o", "files")
    assert ended.code == 0, ended.stderr
    assert "reward_function.py: deepracer-on-aws would refuse it: line 1: import of os" in ended.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["format=onnx"], "RUN: missing"),
        (
            ["nowhere"],
            "format: missing; write format=onnx, format=aws, format=aws-model, or, for a policy that sees with the "
            "camera, format=car",
        ),
        (["nowhere", "format=onnx"], "nowhere: no such run"),
        (
            ["nowhere", "format=coreml"],
            "format=coreml: no such format; accepted: onnx, car, car-openvino, aws, aws-model",
        ),
        (
            ["nowhere", "format=onnx", "chekpoint=last"],
            "chekpoint=last: no such key (did you mean checkpoint?)",
        ),
    ],
)
def test_what_cannot_be_exported_is_refused_in_one_line(call, arguments, words):
    call("export", *arguments).assert_bad_input(words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["format=onnx", "checkpoint=77"], "000077 is not there"),
        (["format=onnx", "-o", "."], "is a folder; give a file"),
        (["format=aws-model"], "observation: has no camera"),
    ],
)
def test_what_a_run_does_not_have_is_refused(trained, call, arguments, words):
    call("export", str(trained().folder), *arguments).assert_bad_input(words)
