"""The study's run in MLflow, however many drivers begin."""

from concurrent.futures import ThreadPoolExecutor

from mlflow import MlflowClient

from deepracer_exp.config.sweep import compose_sweep
from deepracer_exp.tracking.store import resolve_store
from sweeps.space import SearchSpace
from sweeps.storage import open_storage
from sweeps.sweep import begin_study_run


def test_drivers_that_begin_at_once_share_one_run(tmp_path):
    request = compose_sweep(["study=spring", "algorithm.lr=tag(log,interval(1e-5,1e-3))"])
    space, store = SearchSpace.from_request(request), resolve_store(None, tmp_path)
    storages = [open_storage(None, tmp_path) for _ in range(4)]

    def begin(storage):
        return begin_study_run(request, space, store, storage, tmp_path)

    with ThreadPoolExecutor(4) as drivers:
        begun = list(drivers.map(begin, storages))
    assert all(run.finish("FINISHED", 60) for run, _ in begun)
    client = MlflowClient(tracking_uri=f"sqlite:///{tmp_path}/mlflow.db")
    (found,) = client.search_runs([client.get_experiment_by_name("spring").experiment_id])
    assert {run_id for _, run_id in begun} == {found.info.run_id}
