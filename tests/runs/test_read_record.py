"""Files of a run folder that no training wrote."""

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.run_files import read_record


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("metrics.jsonl", '{"iteration": 1}\n{"iter\n{"iteration": 3}\n', "line 2: is not valid JSON"),
        ("metrics.jsonl", "[1]\n", "is not a JSON object"),
        ("config.yaml", "a: [", "not YAML"),
        ("config.yaml", "", "holds no values"),
        ("summary.json", "{", "is not valid JSON"),
    ],
)
def test_files_that_no_training_wrote_are_refused_by_name(tmp_path, name, text, words):
    (tmp_path / "config.yaml").write_text(compose_experiment([])[1].yaml())
    (tmp_path / "metrics.jsonl").write_text('{"iteration": 1}\n')
    (tmp_path / name).write_text(text)
    with pytest.raises(BadInput, match=f"{name}.*{words}"):
        read_record(tmp_path)
