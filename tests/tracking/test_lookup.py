from pathlib import Path

import pytest

from deepracer_exp.errors import BadInput
from deepracer_exp.tracking.lookup import folder_of, is_run_id
from deepracer_exp.tracking.mlflow_run import MLflowRun
from deepracer_exp.tracking.store import resolve_store


def record(runs_dir: Path, **tags: str) -> MLflowRun:
    run = MLflowRun(resolve_store(None, runs_dir))
    run.connect()
    run.create("test", "a run", tags, 0, again=False)
    return run


def test_an_id_leads_to_the_folder_until_the_run_is_deleted(tmp_path):
    run = record(tmp_path, run_dir="/runs/test/one")
    assert run.run_id is not None
    assert is_run_id(run.run_id)
    assert folder_of(run.run_id, None, tmp_path) == Path("/runs/test/one")
    with pytest.raises(BadInput, match="does not know it"):
        folder_of("0" * 32, None, tmp_path)
    run._client.delete_run(run.run_id)
    with pytest.raises(BadInput, match="was deleted in MLflow"):
        folder_of(run.run_id, None, tmp_path)


def test_a_foreign_run_is_refused(tmp_path):
    run = record(tmp_path)
    with pytest.raises(BadInput, match="no run of deepracer-exp"):
        folder_of(str(run.run_id), None, tmp_path)


def test_without_a_store_there_is_nothing_to_look_up(tmp_path):
    with pytest.raises(BadInput, match=r"no mlflow\.db"):
        folder_of("0" * 32, None, tmp_path)
    assert not list(tmp_path.iterdir())
