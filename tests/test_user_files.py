"""The one reader of files that a user gave."""

import os
from pathlib import Path

import pytest

from deepracer_exp.aws.models.archive import read_model
from deepracer_exp.aws.models.hyperparameters import read_hyperparameters
from deepracer_exp.aws.models.model_metadata import read_model_metadata
from deepracer_exp.aws.worlds.routes import read_knots, read_route
from deepracer_exp.config.driving import RewardConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.files import read_yaml
from deepracer_exp.reports.charts.run_charts import stored_completion
from deepracer_exp.rewards.source import load_reward_source
from deepracer_exp.runs.best_run import read_best_of_sweep
from deepracer_exp.runs.checkpoint_files import pinned, verify
from deepracer_exp.runs.labels import read_labels
from deepracer_exp.runs.recording import read_log
from deepracer_exp.runs.run_files import read_config, read_metrics
from deepracer_exp.runs.trace import read_evaluation_others, read_trace
from tests.hostile_files import KINDS, PLACES, make


def _reward(path: Path) -> object:
    return load_reward_source(RewardConfig(name="mine", file=str(path), constants={}, time_limit_s=1.0))


READERS = {
    "my.npy": read_route,
    "my.yaml": read_knots,
    "hyperparameters.json": read_hyperparameters,
    "model_metadata.json": read_model_metadata,
    "reward.py": _reward,
    "config.yaml": lambda path: read_config(path.parent),
    "metrics.jsonl": read_metrics,
    "best_of_sweep.json": lambda path: read_best_of_sweep(path.parent),
    "hashes.json": lambda path: verify(path.parent),
    "pinned.json": lambda path: pinned(path.parent),
    "labels.json": lambda path: read_labels(path.parent),
    "00001-iteration.parquet": lambda path: read_trace(path.parent),
    "others.parquet": lambda path: read_evaluation_others(path.parent),
    "model.tar.gz": lambda path: read_model(str(path), "best"),
    "job.log": read_log,
}


@pytest.mark.parametrize("name", READERS)
def test_whatever_a_file_is_its_reader_takes_it_or_names_it_in_one_line(tmp_path, name):
    for kind in KINDS:
        folder = tmp_path / kind
        folder.mkdir()
        path = make(kind, folder / name)
        complaint = None
        try:
            READERS[name](path)
        except BadInput as error:
            complaint = str(error)
        if complaint is None:
            assert kind not in PLACES or kind == "missing", kind
        else:
            assert str(path) in complaint or kind == "missing", kind
            assert complaint.isprintable(), kind


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: &a [1, 2]\nb: *a\n", r"has an alias, \*a; accepted: the value itself"),
        ("a: [" + "1, " * 100_000 + "]\n", "more than 100,000 values"),
        ("a: " + "[" * 50 + "]" * 50 + "\n", "or 50 levels"),
    ],
)
def test_what_would_take_forever_to_build_is_refused(tmp_path, text, words):
    path = tmp_path / "my.yaml"
    path.write_text(text)
    with pytest.raises(BadInput, match=words):
        read_yaml(path, "YAML")


@pytest.mark.timeout(300)
def test_a_pipe_among_the_evaluations_of_a_run_is_left_out(tmp_path):
    (tmp_path / "evaluations").mkdir()
    os.mkfifo(tmp_path / "evaluations" / "1.json")
    assert stored_completion(tmp_path) == {}
