import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.tracks.track import Track
from deepracer_exp.training.report import write_report

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def track():
    return Track.from_config(compose_experiment([])[0].track)


def test_a_run_without_an_iteration_has_no_pictures(tmp_path, track):
    write_report(tmp_path, track)
    assert not list(tmp_path.iterdir())


def test_a_run_without_a_lap_has_both_pictures(trained, track):
    folder = trained("budget.iterations=1").folder
    for name in ("best_lap.png", "learning.png"):
        (folder / name).unlink()
    write_report(folder, track)
    for name in ("best_lap.png", "learning.png"):
        assert (folder / name).read_bytes().startswith(PNG)


def test_metrics_without_a_trace_are_refused(tmp_path, track):
    (tmp_path / "metrics.jsonl").write_text("{}\n")
    with pytest.raises(BadInput, match="trace"):
        write_report(tmp_path, track)
