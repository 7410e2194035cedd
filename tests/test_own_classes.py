"""Classes of the user's own: the examples of docs/own_classes.md are trained, resumed, raced and refused."""

import json
import re
import shlex
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest
import yaml

from deepracer_exp import load_policy
from deepracer_exp.config import acting
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.runs.next_steps import command_line, next_steps

from .conftest import IN_PROCESS, call_in

DOCS = Path(__file__).parents[1] / "docs"
OWN = (
    *("network=my_network:ResidualNet", "network.kwargs.width=16"),
    *("algorithm=my_algorithm:DecayedPPO", "algorithm.kwargs.decay=1e-3"),
    *("algorithm.frames_per_iteration=256", "algorithm.batch_size=128", "budget.env_steps=1024"),
    *("lr_schedule=my_schedule:Triangle", "lr_schedule.kwargs.period=4"),
    "observation=my_features:SideForce",
    *("stopping=my_rule:LapUnder", "stopping.kwargs.seconds=1.0"),
)
NAMED = (
    *("network.target=my_network:ResidualNet", "algorithm.target=my_algorithm:DecayedPPO"),
    *("lr_schedule.target=my_schedule:Triangle", "observation.target=my_features:SideForce"),
    *("stopping.target=my_rule:LapUnder", "tracking.target=my_tracker:JsonTracker"),
)
SHORT = ("evaluation.trials=1", "evaluation.laps=1", "evaluation.time_s=5", "evaluation.held_out=null")
TIMES = ["wall_clock_s", "collect_s", "update_s", "env_steps_per_s"]


def write_examples(folder: Path) -> Path:
    pages = (DOCS / name for name in ("extending.md", "own_classes.md"))
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    for name, content in re.findall(r'^```\w+ title="([^"]+)"\n(.*?)^```', text, re.DOTALL | re.MULTILINE):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content, encoding="utf-8")
    return folder


@pytest.fixture(autouse=True)
def _forgotten(monkeypatch, tmp_path_factory):
    """Begin like a new command of another account, which has used none of these classes."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("account")))
    monkeypatch.setattr(acting, "_named", {})
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name in [name for name in sys.modules if name.startswith("my_")]:
        monkeypatch.delitem(sys.modules, name)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Train with every kind of own class; return the run's folder, below the examples' folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", list(sys.path))
        folder = write_examples(tmp_path_factory.mktemp("own"))
        ended = call_in(folder, "train", *IN_PROCESS, *OWN, "tracking=my_tracker:JsonTracker")
        assert ended.code == 0, ended.stderr
        return ended.folder


def metrics(run: Path) -> pd.DataFrame:
    return pd.read_json(run / "metrics.jsonl", lines=True).drop(columns=TIMES)


def curves(run: Path) -> pd.DataFrame:
    return pd.read_json(run / "curves.jsonl", lines=True).drop(columns=TIMES)


def at_home(run: Path) -> Path:
    return run.parents[2]


def test_every_class_does_its_part(run, monkeypatch):
    monkeypatch.chdir(at_home(run))
    rows = metrics(run)
    assert rows["lr"].tolist() == pytest.approx([1.3e-3, 7.15e-4, 1.3e-4, 7.15e-4])
    assert curves(run)["completion"].dropna().tolist() == pytest.approx(rows["completion"].tolist())
    compose_experiment(OWN)  # names the classes for this process
    policy = load_policy(run, "last", run.parents[1])
    first = next(policy.parameters())
    assert first.shape == (16, 20)


def test_a_run_stores_names_of_classes_and_no_code(run):
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["network"] == {"target": "my_network:ResidualNet", "kwargs": {"width": 16}}
    for file in run.rglob("*"):
        if file.is_file() and file.suffix != ".png":
            assert b"class ResidualNet" not in file.read_bytes(), file


@pytest.mark.parametrize("command", ["resume", "clone", "evaluate", "watch", "export"])
def test_a_stored_run_imports_no_code_by_itself(run, command):
    extra = {"resume": ["budget.env_steps=2048"], "export": ["format=onnx"]}.get(command, [])
    ended = call_in(at_home(run), command, run.name, *extra)
    ended.assert_refused("named by a stored run, which imports no code by itself", ".target=my_")
    assert not [name for name in sys.modules if name.startswith("my_")]


def test_a_run_is_raced_where_its_classes_are_named_again(run):
    ended = call_in(at_home(run), "evaluate", run.name, *SHORT, *NAMED[:1], NAMED[3], "checkpoint=last")
    assert ended.code == 0, ended.stderr


def test_the_lines_to_paste_name_the_classes_again(run, tmp_path):
    home = shutil.copytree(at_home(run), tmp_path / "home", symlinks=True)
    copy = home / run.relative_to(at_home(run))
    steps = [line for line, _ in next_steps(copy, json.loads((copy / "summary.json").read_text()))]
    assert len(steps) == 4
    for line in steps:
        acting._named.clear()
        command, *words = shlex.split(line)[1:]
        if "--video" not in words:  # needs a renderer
            extra = SHORT if command == "evaluate" else ("budget.env_steps=256",) * (command == "clone")
            ended = call_in(home, command, *words, *extra)
            assert ended.code == 0, (line, ended.stderr)


def test_a_line_to_paste_runs_nothing_that_the_run_has_written_into_it():
    config = {"network": {"target": "a:B; reboot"}, "observation": {"parts": ["$(reboot)", {"target": 1}]}}
    line = command_line("evaluate", "my run", {**config, "stopping": [{"target": "c:D"}], "algorithm": None})
    assert shlex.split(line) == ["deepracer-exp", "evaluate", "my run", "network.target=a:B; reboot"]


def test_a_resumed_run_of_own_classes_equals_an_uninterrupted_one(run, tmp_path):
    write_examples(tmp_path)
    options = (*IN_PROCESS, *OWN, "tracking=my_tracker:JsonTracker")
    half = call_in(tmp_path, "train", *options, "budget.env_steps=512").folder
    acting._named.clear()
    ended = call_in(tmp_path, "resume", half.name, *NAMED, "budget.env_steps=1024")
    assert ended.code == 0, ended.stderr
    pd.testing.assert_frame_equal(metrics(half), metrics(run))
    pd.testing.assert_frame_equal(curves(half), curves(run))


def test_a_resumed_run_needs_the_same_class_importable(run, tmp_path):
    ended = call_in(tmp_path, "evaluate", str(run), *NAMED)
    ended.assert_refused("network.target=my_network:ResidualNet: ModuleNotFoundError")


BROKEN = """
import torch
from deepracer_exp import Algorithm, ObservationPart, StoppingRule

class WrongSize(torch.nn.Linear):
    def __init__(self, inputs, outputs):
        super().__init__(inputs, outputs + 1)

class NoForward(torch.nn.Module):
    def __init__(self, inputs, outputs):
        super().__init__()

class NoComma(ObservationPart):
    names = ("side_force")
    def compute(self, now, steering_deg, commanded_mps):
        return now.speed_mps[:, None]

class OneOfTwo(NoComma):
    names = ("side_force", "lift")

class NoNetworks(Algorithm):
    def __init__(self, *arguments):
        pass

class Divides(Algorithm):
    def update(self, batch, iteration, fraction):
        return 1 / 0

class Multiplies(Algorithm):
    def update(self, batch, iteration, fraction):
        return torch.nn.Linear(3, 1)(batch["observation"])

class Raises(StoppingRule):
    def observe(self, row):
        return row["no_such_column"]

class SaysYes(StoppingRule):
    def observe(self, row):
        return True
"""


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("network=nowhere:Net", "network.target=nowhere:Net: ModuleNotFoundError: No module named 'nowhere'"),
        ("network=my_network:Wide", "AttributeError: module 'my_network' has no attribute 'Wide'"),
        ("network=my_network:nn", "network.target=my_network:nn: is a module; accepted: a class"),
        ("network=my_rule:LapUnder", "accepted: a subclass of torch.nn.modules.module.Module"),
        ("lr_schedule=my_rule:LapUnder", "accepted: a subclass of deepracer_exp.agents.schedules.Schedule"),
        ("algorithm=my_rule:LapUnder", "accepted: a subclass of deepracer_exp.agents.algorithm.Algorithm"),
        (
            "observation=my_rule:LapUnder",
            "accepted: a subclass of deepracer_exp.env.observation.ObservationPart",
        ),
        ("tracking=my_rule:LapUnder", "accepted: a subclass of deepracer_exp.tracking.tracker.Tracker"),
        (
            "stopping=my_rule:LapUnder",
            "stopping.target=my_rule:LapUnder: missing a required argument: 'seconds'",
        ),
        ("algorithm.kwargs.decay=1", "algorithm: kwargs are arguments of a class of your own"),
        ("network.kwargs.width=1", "network.kwargs: no such key"),
        ("network=my_broken:WrongSize", "(2, 3) for two observations; accepted: a tensor of shape (2, 2)"),
        ("network=my_broken:NoForward", "network.target=my_broken:NoForward: Module [NoForward] is missing"),
        ("observation=my_broken:NoComma", "names='side_force'; accepted: a tuple of text"),
        ("observation=my_broken:OneOfTwo", "compute returns the shape (2, 1) for two cars; accepted: (2, 2)"),
        ("algorithm=my_broken:NoNetworks", "AttributeError: 'NoNetworks' object has no attribute 'networks'"),
    ],
)
def test_a_class_that_cannot_be_used_or_would_mislead_the_training_is_refused(override, words, tmp_path):
    (write_examples(tmp_path) / "my_broken.py").write_text(BROKEN)
    call_in(tmp_path, "train", *IN_PROCESS, override).assert_bad_input(words)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        (
            "algorithm=my_broken:Divides",
            "ZeroDivisionError: division by zero (my_broken.py, line 27; with algorithm.target=my_broken:Divides)",
        ),
        # Raised in torch: the line is the last one of the class's own module.
        (
            "algorithm=my_broken:Multiplies",
            "(my_broken.py, line 31; with algorithm.target=my_broken:Multiplies)",
        ),
        (
            "stopping=my_broken:Raises",
            "KeyError: 'no_such_column' (my_broken.py, line 35; with stopping.target=",
        ),
        (
            "stopping=my_broken:SaysYes",
            "SaysYes.observe returned True: 'bool' object has no attribute 'as_dict'",
        ),
    ],
)
def test_an_error_of_a_class_ends_the_run_in_one_line_that_names_it(override, words, tmp_path):
    (tmp_path / "my_broken.py").write_text(BROKEN)
    call_in(tmp_path, "train", *IN_PROCESS, override).assert_run_failed(words)


def test_a_file_of_the_working_folder_replaces_no_installed_module(tmp_path):
    (tmp_path / "colorsys.py").write_text("class Net: ...\n")
    sys.modules.pop("colorsys", None)
    ended = call_in(tmp_path, "train", *IN_PROCESS, "network=colorsys:Net")
    ended.assert_bad_input("module 'colorsys' has no attribute 'Net'")


@pytest.mark.slow
def test_workers_drive_with_own_classes(run_at, tmp_path):
    write_examples(tmp_path)
    options = ("experiment=tiny", "tracking=my_tracker:JsonTracker", "collector.processes=2", *OWN)
    ended = run_at(tmp_path, "train", *options)
    assert ended.code == 0, ended.stderr
