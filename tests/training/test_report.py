import pytest

from deepracer_exp.analysis.log_tables import headline
from deepracer_exp.analysis.log_view import prepare
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.setup import build_courses
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.own_recording import read_own_recording
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


def test_the_page_counts_the_episodes_that_the_summary_counts(trained):
    ended = trained("budget.iterations=1")
    view = prepare(read_own_recording(ended.folder))
    assert len(view.episodes) > ended.summary["episodes"] > 0  # some were still being driven at the end
    assert f" in {ended.summary['episodes']} finished episodes and 1 iteration" in headline(view)
