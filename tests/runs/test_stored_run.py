"""A stored run, and the files it was made from."""

from pathlib import Path

import pytest
import yaml

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.reports.tables.groups import course_of
from deepracer_exp.reports.tables.log_view import prepare
from deepracer_exp.rewards.source import load_reward_source
from deepracer_exp.runs.folder import RunFolder
from deepracer_exp.runs.next_steps import outcome
from deepracer_exp.runs.recording import read_run_recording
from deepracer_exp.runs.run_files import read_record
from deepracer_exp.runs.stored_run import StoredRun

KNOTS = [[0, 0], [2, 0], [3, 1], [2, 2], [0, 2], [-1, 1]]


def track_file(folder: Path, name: str, width_m: float) -> Path:
    file = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump({"width_m": width_m, "knots": KNOTS}))
    return file


@pytest.mark.parametrize("tracks", [1, 2])
def test_a_file_of_a_track_that_has_changed_is_named(tmp_path, caplog, tracks):
    files = [track_file(tmp_path, name, 0.8) for name in ("Own", "Other")]
    asked = [f"track.file={files[0]}"]
    if tracks == 2:
        asked = [
            "track=[Oval_track,AWS_track]",
            *(
                f"track.{name}.file={file}"
                for name, file in zip(("Oval_track", "AWS_track"), files, strict=True)
            ),
        ]
    experiment, composition = compose_experiment(asked)
    folder = RunFolder.create(str(tmp_path), "own", "run")
    folder.describe(composition, load_reward_source(experiment.reward), experiment, {})
    folder.release()
    assert StoredRun(folder.path).experiment == experiment
    assert caplog.messages == []
    track_file(tmp_path, "Own", 0.7)
    assert StoredRun(folder.path).experiment == experiment
    assert caplog.messages == [f"{folder.path.name}: {files[0]} has other contents than when the run began"]


def test_a_track_of_a_file_is_called_like_the_file_wherever_it_is_named(train_here, tmp_path):
    ended = train_here(f"track.file={track_file(tmp_path, 'My_Lane', 0.8)}", "budget.iterations=1")
    assert ended.code == 0, ended.stderr
    view = prepare(read_run_recording(ended.folder))
    assert view.problems == ()
    assert (view.track_name, view.course.name) == ("My_Lane", "My_Lane")
    assert course_of(read_record(ended.folder)) == "My_Lane"
    assert dict(outcome(read_record(ended.folder)))["Track"] == "My_Lane"
