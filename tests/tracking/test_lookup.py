import pytest

from deepracer_exp.errors import BadInput
from deepracer_exp.tracking.store import folder_of, is_run_id


def test_an_id_leads_to_the_folder_until_the_run_is_deleted(season, client):
    run = season.run("one")
    run_id = season.recorded(run, client)
    assert is_run_id(run_id)
    assert folder_of(run_id, None, season.runs_dir) == run
    with pytest.raises(BadInput, match=r"Run with id=0+ not found"):
        folder_of("0" * 32, None, season.runs_dir)
    client.delete_run(run_id)
    with pytest.raises(BadInput, match="was deleted in MLflow"):
        folder_of(run_id, None, season.runs_dir)


def test_a_foreign_run_is_refused(season, client):
    run_id = client.create_run("0").info.run_id
    with pytest.raises(BadInput, match="not a run of deepracer-exp"):
        folder_of(run_id, None, season.runs_dir)


def test_without_a_store_there_is_nothing_to_look_up(tmp_path):
    with pytest.raises(BadInput, match=r"no mlflow\.db"):
        folder_of("0" * 32, None, tmp_path)
    assert not list(tmp_path.iterdir())
