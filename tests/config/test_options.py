from pathlib import Path

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.options import conf_dir, conf_dirs, groups, options
from deepracer_exp.errors import BadInput


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stand in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def own(folder: Path, name: str, text: str) -> Path:
    path = folder / "conf" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


BUDGET = "defaults: [default, _self_]\nenv_steps: 777\n"


def test_options_of_the_working_folder_stand_beside_the_projects(here):
    before = options("budget")
    own(here, "budget/mine.yaml", BUDGET)
    assert options("budget") == sorted([*before, "mine"])
    experiment, composition = compose_experiment(["budget=mine"])
    assert (experiment.budget.env_steps, composition.choices["budget"]) == (777, "mine")
    assert compose_experiment(["budget=short"])[0].budget.env_steps == 200_000


def test_an_option_of_ones_own_may_begin_with_one_of_the_projects(here):
    own(here, "budget/mine.yaml", "defaults: [short]\niterations: 3\n")
    budget = compose_experiment(["budget=mine"])[0].budget
    assert (budget.env_steps, budget.iterations) == (200_000, 3)


def test_the_nearest_of_all_options_is_told(here):
    own(here, "budget/mine_all.yaml", BUDGET)
    with pytest.raises(BadInput, match=r"did you mean mine_all\?.*long, mine_all, short"):
        compose_experiment(["budget=mine_al"])


def test_a_namesake_that_is_not_the_same_is_refused_whatever_is_chosen(here):
    path = own(here, "budget/short.yaml", (conf_dir() / "budget/short.yaml").read_text())
    assert len(compose_experiment([])[0].name) > 0
    path.write_text(BUDGET)
    with pytest.raises(
        BadInput, match=r"conf/budget/short\.yaml: the project has another budget of that name"
    ):
        compose_experiment([])
    with pytest.raises(BadInput, match="rename the file"):
        options("track")


def test_the_projects_own_folder_is_searched_once(monkeypatch):
    monkeypatch.chdir(conf_dir().parent)
    assert conf_dirs() == [conf_dir().resolve()]


def test_a_conf_folder_of_something_else_does_no_harm(here):
    before = groups()
    own(here, "train.yaml", "seed: 99\n")
    own(here, "database/x.yaml", "a: 1\n")
    (here / "conf/budget").write_text("a file")
    assert groups() == before
    assert compose_experiment([])[0].seed == 0


def test_a_file_called_conf_does_no_harm(here):
    (here / "conf").write_text("")
    assert conf_dirs() == [conf_dir().resolve()]


def test_any_path_of_the_working_folder_will_do(tmp_path, monkeypatch):
    folder = tmp_path / "mein Ordner, (ü) = '$x'"
    folder.mkdir()
    monkeypatch.chdir(folder)
    own(folder, "budget/mine.yaml", BUDGET)
    assert compose_experiment(["budget=mine"])[0].budget.env_steps == 777
