"""README and docs agree with the program."""

import importlib.util
import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import yaml

from deepracer_exp.cli import parse
from deepracer_exp.commands.arguments import runs_and_overrides
from deepracer_exp.commands.validation.pitfalls import lap_returns, slow_laps_return_as_much
from deepracer_exp.commands.validation.simple_driver import action_space_laps
from deepracer_exp.commands.validation.validate import read
from deepracer_exp.config.compose import compose_evaluation, compose_experiment, expand_grid
from deepracer_exp.config.options import conf_dir, groups, options
from deepracer_exp.config.sweep import compose_sweep
from tests.test_own_classes import write_examples

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LONG_GUIDES = {"gallery.md", "upgrade.md"}


def _name(page):
    return page.relative_to(ROOT).as_posix()


def _anchors(page):
    """Return the anchors of a page's headings, as both the site and GitHub make them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    words = [re.sub(r"[^\w\s-]", "", re.sub(r"\]\(.*?\)", "", heading)) for heading in headings]
    return {re.sub(r"\s+", "-", heading.strip().lower()) for heading in words}


def _reference():
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs" / "reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_readme_has_at_most_120_lines():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_every_linked_file_and_heading_exists(page):
    for link, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", page.read_text(encoding="utf-8")):
        if not link.startswith("http"):
            target = page.parent / link if link else page
            assert target.is_file(), link
            assert not anchor or anchor in _anchors(target), f"{link}#{anchor}"


@pytest.mark.parametrize("name", ["commands.md", "configuration.md"])
def test_a_generated_page_is_what_its_generator_writes(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # without options of its own
    page = _reference().PAGES[name]()
    committed = (ROOT / "docs" / name).read_text(encoding="utf-8")
    assert committed == page, f"docs/{name} is out of date: `python docs/reference.py` writes it"


def test_the_configuration_page_has_every_group_and_option_and_the_default_in_bold():
    page = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    defaults = yaml.safe_load((conf_dir() / "train.yaml").read_text(encoding="utf-8"))["defaults"]
    chosen = {
        group: option for entry in defaults if isinstance(entry, dict) for group, option in entry.items()
    }
    assert sorted(chosen) == groups()
    for group, option in chosen.items():
        section = re.split(r"^## ", page.split(f"\n## {group}\n")[1], flags=re.MULTILINE)[0]
        assert set(options(group)) <= set(re.findall(r"`(\w+)`", section)), group
        assert option is None or f"**`{option}`**" in section


def test_the_page_of_commands_has_every_command():
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    headings = set(re.findall(r"^## (.+)$", page, re.MULTILINE))
    assert {"train", "evaluate", "compare", "runs clean", "sweep", "ui"} <= headings


def test_the_site_lists_every_page():
    listed = re.findall(r": ([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    docs = ROOT / "docs"
    pages = {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")}
    assert sorted(listed) == sorted(pages)


def test_a_guide_has_at_most_900_words():
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    (guides,) = (section["Guides"] for section in site["nav"] if "Guides" in section)
    names = {name for guide in guides for name in guide.values()}
    words = {name: len((ROOT / "docs" / name).read_text(encoding="utf-8").split()) for name in names}
    assert {name for name in names if words[name] > 900} <= LONG_GUIDES


def test_the_picture_of_the_layers_shows_those_that_are_checked():
    contract = re.search(
        r"^layers = \[(.*?)^\]", (ROOT / "pyproject.toml").read_text(), re.DOTALL | re.MULTILINE
    )
    rows = [re.findall(r"[\w.]+", row) for row in re.findall(r'"(.*)"', contract.group(1))]
    package = {name: ROOT / "deepracer_exp" / name.replace(".", "/") for row in rows for name in row}
    packages = [[name for name in row if package[name].is_dir()] for row in rows]
    shown = re.findall(r'font-weight="bold"[^>]*>([\w.]+)<', (ROOT / "docs/images/layers.svg").read_text())
    assert sorted(shown) == sorted(name for row in packages for name in row)
    position = {name: index for index, row in enumerate(packages) for name in row}
    assert [position[name] for name in shown] == sorted(position[name] for name in shown)


def _commands():
    """Return every command that a page shows in a block of code, without its comment; each once."""
    shown = {}
    for page in PAGES:
        text = page.read_text(encoding="utf-8").replace("\\\n", "")
        for line in re.findall(r"^(?:    |\$ )?(deepracer-exp .*)$", text, re.MULTILINE):
            words = shlex.split(line, comments=True)
            if "..." not in words and "COMMAND" not in words:
                shown.setdefault(tuple(words[1:]), _name(page))
    return [pytest.param(words, id=f"{page}: {shlex.join(words)}") for words, page in shown.items()]


@pytest.fixture(autouse=True)
def _path_restored(monkeypatch):
    """Forget the working folder, which a command that names own classes adds to the import path."""
    monkeypatch.setattr(sys, "path", list(sys.path))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a working folder with the files that the commands name, among them those of our examples."""
    folder = tmp_path_factory.mktemp("docs")
    write_examples(folder)
    for name in ("DIR", "model_1", "model_2"):
        (folder / name).mkdir()
        (folder / name / "reward_function.py").write_text(
            "SPEED = 1\n\ndef reward_function(params):\n    return SPEED * params['speed']\n",
            encoding="utf-8",
        )
    actions = {"action_space": [{"steering_angle": 0, "speed": 1}], "action_space_type": "discrete"}
    (folder / "model_metadata.json").write_text(json.dumps(actions), encoding="utf-8")
    np.save(folder / "my_route.npy", np.array([[np.cos(t), np.sin(t)] * 3 for t in np.linspace(0, 6, 50)]))
    options = folder / "conf" / "experiment"
    (options / "my_model.yaml").write_text("# @package _global_\nname: my_model\n", encoding="utf-8")
    actions = folder / "conf" / "action_space"
    actions.mkdir(exist_ok=True)
    shutil.copy(conf_dir() / "action_space" / "grid.yaml", actions / "season.yaml")
    return folder


@pytest.mark.parametrize("words", _commands())
def test_every_command_shown_is_accepted(words, folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HOME", str(folder))
    monkeypatch.setenv("STUDY_DB", "postgresql+psycopg://racer@host/study")
    words = [re.sub(r"~/deepracer-for-cloud/custom_files", "DIR", word) for word in words]
    words = [
        {"track=NAME": "track=Oval_track", "sweep=NAME": "sweep=season"}.get(word, word) for word in words
    ]
    args = parse(words)
    if words[0] == "train":
        for overrides in expand_grid(args.overrides) if args.multirun else [args.overrides]:
            compose_experiment(overrides)
    elif words[0] == "validate":
        compose_experiment([word for word in args.overrides if not word.startswith("trial=")])
    elif words[0] in ("evaluate", "watch"):
        compose_evaluation(runs_and_overrides(args)[1])
    elif words[0] == "sweep" and args.overrides[0] not in ("report", "best"):
        compose_sweep(args.overrides)


def _examples():
    page = (ROOT / "docs" / "from_python.md").read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("example", _examples(), ids=lambda example: example.split("\n")[0])
def test_every_python_example_runs(example, tmp_path):
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_example_of_a_batched_reward_pays_what_the_scalar_one_pays(folder):
    module = runpy.run_path(str(folder / "my_fast_reward.py"))
    batch = {"all_wheels_on_track": np.array([True, False]), "speed": np.array([2.0, 3.0])}
    each = [
        module["reward_function"]({key: column[car] for key, column in batch.items()}) for car in range(2)
    ]
    assert module["reward_batch"](batch).tolist() == each


def test_the_tutorial_quotes_what_validate_says_of_its_reward_function(tmp_path):
    page = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    code = re.search(r"^Save this as `my_reward.py`.*\n\n((?:    .*\n|\n)+)", page, re.MULTILINE)
    file = tmp_path / "my_reward.py"
    file.write_text(textwrap.dedent(code.group(1)), encoding="utf-8")
    mended = re.search(r"validate reward\.file=my_reward\.py (reward\.constants\.\S+)", page).group(1)
    setup, better = (
        read(compose_experiment([f"reward.file={file}", *more])[0]).setup for more in ((), (mended,))
    )
    laps = action_space_laps(setup)
    (warning,) = slow_laps_return_as_much(lap_returns(setup, laps, 0.99), 0.99)
    assert warning.partition(": ")[2].partition(";")[0] in page
    assert not list(slow_laps_return_as_much(lap_returns(better, laps, 0.99), 0.99))


def _imports():
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    return sorted(set(re.findall(r"^ *((?:from|import) deepracer_exp.*?)(?: *#.*)?$", text, re.MULTILINE)))


@pytest.mark.parametrize("line", _imports())
def test_every_import_shown_works(line):
    exec(line, {})


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_every_file_of_ours_that_is_named_exists(page):
    named = re.findall(
        r"`((?:deepracer_exp|sweeps|tests|benchmarks|conf|docs)/[\w/.-]+)`", page.read_text("utf-8")
    )
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_reading_the_code_counts_its_files_and_names_functions_that_are_in_them():
    page = (ROOT / "docs" / "reading_the_code.md").read_text(encoding="utf-8")
    file = r"`(deepracer_exp/[\w/]+\.py)`"
    for section in page.split("\n## ")[1:]:
        counted = set(re.findall(file, section)) - {"deepracer_exp/sweeps/run_sweep.py"}
        assert f"**{len(counted)} files**" in " ".join(section.split())
    for path, named in re.findall(rf"{file}((?:(?:,| and)\s+`[\w.]+`)+)", page):
        text = (ROOT / path).read_text(encoding="utf-8")
        for name in re.findall(r"`([\w.]+)`", named):
            for part in name.split("."):
                assert re.search(rf"^ *(?:(?:class|def) {part}\b|{part} = )", text, re.MULTILINE), (
                    f"{path}: {name}"
                )
