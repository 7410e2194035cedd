from deepracer_exp.analysis.log_tables import headline
from deepracer_exp.analysis.log_view import prepare
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.setup import build_courses
from deepracer_exp.runs.own_recording import read_own_recording
from deepracer_exp.training.callbacks import write_pictures

PNG = b"\x89PNG\r\n\x1a\n"


def test_a_run_has_pictures_as_soon_as_it_has_an_iteration(trained, tmp_path):
    courses = build_courses(compose_experiment([])[0])
    write_pictures(tmp_path, courses)
    assert not list(tmp_path.iterdir())
    folder = trained("budget.iterations=1").folder  # without a lap
    for name in ("best_lap.png", "learning.png"):
        assert (folder / name).read_bytes().startswith(PNG)


def test_the_page_counts_the_episodes_that_the_summary_counts(trained):
    ended = trained("budget.iterations=1")
    view = prepare(read_own_recording(ended.folder))
    assert len(view.episodes) > ended.summary["episodes"] > 0  # some were still being driven at the end
    assert f" in {ended.summary['episodes']} finished episodes and 1 iteration" in headline(view)
