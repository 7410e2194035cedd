import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.courses import build_courses
from deepracer_exp.errors import BadInput
from deepracer_exp.training.report import write_pictures

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def courses():
    return build_courses(compose_experiment([])[0])


def test_a_run_without_an_iteration_has_no_pictures(tmp_path, courses):
    write_pictures(tmp_path, courses)
    assert not list(tmp_path.iterdir())


def test_a_run_without_a_lap_has_both_pictures(trained, courses):
    folder = trained("budget.iterations=1").folder
    for name in ("best_lap.png", "learning.png"):
        (folder / name).unlink()
    write_pictures(folder, courses)
    for name in ("best_lap.png", "learning.png"):
        assert (folder / name).read_bytes().startswith(PNG)


def test_metrics_without_a_trace_are_refused(tmp_path, courses):
    (tmp_path / "metrics.jsonl").write_text("{}\n")
    with pytest.raises(BadInput, match="trace"):
        write_pictures(tmp_path, courses)
