import json
import os
import shlex
import subprocess
import sys

import pytest
import yaml

from deepracer_exp import __version__
from deepracer_exp.aws.worlds.catalogue import leaders, worlds
from deepracer_exp.config.options import groups
from deepracer_exp.evaluation.fastest import lap_search

HEAVY = (
    "torch",
    "tensordict",
    "torchrl",
    "numpy",
    "hydra",
    "omegaconf",
    "mujoco",
    "mlflow",
    "pandas",
    "rich",
    "pydantic",
)


LIGHT = ["--help", "train --help", "import --help", "tracks --help", "ui --help", "--version"]


@pytest.mark.parametrize(("given", "set_to"), [(None, "passive"), ("active", "active")])
def test_threads_of_torch_leave_their_cores_while_they_wait_unless_told_otherwise(given, set_to):
    code = """
import contextlib, os
from deepracer_exp.cli import main
with contextlib.suppress(SystemExit):
    main(["--version"])
print(os.environ["OMP_WAIT_POLICY"])
"""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {} if given is None else {"OMP_WAIT_POLICY": given}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, check=True, stdout=subprocess.PIPE, text=True
    )
    assert done.stdout.split()[-1] == set_to


def test_help_imports_nothing_that_takes_time():
    code = f"""
import contextlib, io, sys
from deepracer_exp.cli import main
for line in {LIGHT!r}:
    said = io.StringIO()
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(said):
        main(line.split())
    print(line, bool(said.getvalue()), [name for name in {HEAVY!r} if name in sys.modules], sep=": ")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [f"{line}: True: []" for line in LIGHT]


def test_version_is_the_packages(call):
    assert call("--version").stdout == f"deepracer-exp {__version__}\n"


COMMANDS = (
    *("train", "resume", "clone", "sweep", "runs", "ui", "evaluate", "check", "watch"),
    *("checkpoints", "analyze", "compare", "validate", "import", "export", "tracks"),
)


def test_help_names_every_command(call):
    lines = call("--help").stdout.splitlines()
    listed = {line.split()[0] for line in lines if line.startswith("    ")}
    assert set(COMMANDS) <= listed


def test_help_of_train_names_every_group(call):
    text = call("train", "--help").stdout
    listed = text[text.index("Groups:") :].split()
    assert set(groups()) <= set(listed)


def test_cfg_prints_the_experiment_and_runs_nothing(call, tmp_path):
    ended = call("train", "experiment=tiny", "seed=5", "--cfg")
    assert ended.code == 0
    assert yaml.safe_load(ended.stdout)["seed"] == 5
    assert not list(tmp_path.iterdir())


def test_cfg_of_a_grid_prints_every_combination(call):
    ended = call("train", "-m", "seed=1,2", "network=mlp,mlp_small", "--cfg")
    assert [one["seed"] for one in yaml.safe_load_all(ended.stdout)] == [1, 1, 2, 2]


def test_options_may_stand_between_overrides(call):
    ended = call("train", "network=mlp", "-m", "seed=1,2", "--cfg", "name=between")
    assert [(one["seed"], one["name"]) for one in yaml.safe_load_all(ended.stdout)] == [
        (1, "between"),
        (2, "between"),
    ]


@pytest.mark.parametrize("arguments", [["train", "seed=1", "--fast"], ["tracks", "a", "b"]])
def test_an_unknown_argument_is_refused(call, arguments):
    call(*arguments).assert_bad_input(f"unrecognized arguments: {arguments[-1]}")


def test_a_grid_without_m_is_refused(call):
    call("train", "experiment=tiny", "seed=1,2").assert_bad_input("seed=1,2")


def test_without_a_command_the_help_is_printed(call):
    alone, asked = call(), call("--help")
    assert (alone.code, alone.stdout, alone.stderr) == (0, asked.stdout, "")
    assert "train" in alone.stdout


QUICK = (
    "budget.iterations=1",
    "evaluation.trials=1",
    "evaluation.time_s=2",
    "evaluation.held_out=null",
)


def test_a_grid_ends_with_a_table_of_its_runs_and_of_their_groups(train_here, call):
    ended = train_here("-m", *QUICK, "seed=1,2")
    assert ended.code == 0, ended.stderr
    assert len(ended.folders) == 2
    seeds = [json.loads((folder / "summary.json").read_text())["seed"] for folder in ended.folders]
    assert sorted(seeds) == [1, 2]
    table, groups = ended.stdout.split("\n2 runs:\n")[1].split("\nGroups\n")
    assert table.count("\n") == 2
    for folder in ended.folders:
        assert folder.name in table
    (named,) = [line.split() for line in groups.splitlines() if line.startswith("tiny ")]
    assert named[:2] == ["tiny", "2"]
    # The command that is printed draws their curves.
    line = next(line for line in ended.stdout.splitlines() if " compare " in line)
    words = shlex.split(line, comments=True)
    assert call("compare", *words[2:]).code == 0
    assert list(ended.cwd.glob("*-comparison.html"))


def test_a_grid_of_single_runs_has_no_groups(train_here):
    ended = train_here("-m", *QUICK, "algorithm.lr=1e-4,1e-3")
    assert "2 runs:" in ended.stdout
    assert "Groups" not in ended.stdout


def test_tracks_lists_each_family_once_with_its_variants(call, tmp_path):
    own = tmp_path / "conf" / "track"
    own.mkdir(parents=True)
    (own / "broken.yaml").write_text("defaults: [reinvent_base, _self_]\nname: broken\nfile: gone.npy\n")
    text = call("tracks").stdout
    assert "\nbroken: track.file: gone.npy: cannot be read" in text
    lines = [line.split() for line in text.splitlines()]
    named = {line[0]: line for line in lines if line}
    assert set(leaders()) <= named.keys()
    assert not (worlds().keys() - set(leaders())) & named.keys()
    assert named["2022_april_open"][-5:] == ["50.30", "1.07", "169", "…_ccw", "…_cw"]
    assert named["reinvent_base"][-1] == "reinvent_wood"
    assert named["broken"] == ["broken", "unusable"]


def test_tracks_draws_one_and_writes_nothing_unasked(call, tmp_path):
    text = call("tracks", "Circuit de Barcelona-Catalunya").stdout
    assert text.startswith(
        "Circuit de Barcelona-Catalunya (Spain_track): 60.00 m, 0.91 m wide, 259 waypoints"
    )
    assert text.count("\n") > 12
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("output", ["picture.png", "picture"])
def test_tracks_draws_a_picture_of_one_and_says_where_it_is(call, tmp_path, output):
    ended = call("tracks", "reinvent_base", "-o", output)
    assert ended.code == 0
    assert "re:Invent 2018" in ended.stdout
    assert ended.stdout.endswith("\npicture: picture.png\n")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")


def test_tracks_writes_the_racing_line_of_one_and_says_where_it_is(call, tmp_path):
    ended = call("tracks", "Oval_track", "--line", "line.csv")
    assert ended.code == 0
    assert ended.stdout.endswith("\nracing line: line.csv\n")
    assert (tmp_path / "line.csv").read_text().startswith("x_m,y_m,progress\n")


def test_tracks_finds_the_fastest_lap_and_writes_its_line(call, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(lap_search, "PASSES", lap_search.PASSES[:1])
    ended = call("tracks", "Straight_track", "--fastest", "--line", "line.csv", "-o", "lap.png")
    assert ended.code == 0, ended.stderr
    assert "fastest lap of deepracer_v6: 1." in ended.stdout
    assert "commands between -30 and 30 degrees, 1 and 4 m/s" in ended.stdout
    rows = (tmp_path / "line.csv").read_text().splitlines()
    assert rows[0] == "x_m,y_m,speed_mps,progress"
    assert rows[-1].endswith(",100.0")
    assert (tmp_path / "lap.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["tracks", "reinvent"], "did you mean reinvent_base?"),
        (["tracks", "missing.npy"], "missing.npy"),
        (["tracks", "reinvent_base", "-o", "no/such/folder.png"], "no/such/folder.png"),
        (["tracks", "reinvent_base", "-o", "picture.nothing"], "picture.nothing"),
        (["tracks", "-o", "picture.png"], "picture.png"),
        (["tracks", "--line", "line.csv"], "line.csv"),
        (["tracks", "reinvent_base", "--line", "line.json"], "line.json"),
        (["tracks", "--fastest"], "tracks NAME --fastest"),
        (["tracks", "car=deepracer_v5"], "tracks NAME"),
        (["tracks", "reinvent_base", "--fastest", "car=fast"], "car=fast"),
    ],
)
def test_a_picture_that_cannot_be_drawn_is_bad_input(call, arguments, word):
    call(*arguments).assert_bad_input(word)


def test_output_into_a_pipe_that_closes_early_is_no_traceback(tmp_path):
    command = f"{sys.executable} -m deepracer_exp.cli tracks | head -n 1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr


# --- import


def write_custom_files(folder, reward="def reward_function(params):\n    return params['speed']\n"):
    folder.mkdir()
    (folder / "reward_function.py").write_text(reward)
    return folder


def test_an_imported_experiment_trains(call, tmp_path):
    folder = write_custom_files(tmp_path / "custom_files")
    ended = call("import", str(folder), "--name", "mine")
    assert ended.code == 0
    assert ended.stdout.splitlines()[:3] == [
        "conf/reward/mine.py",
        "conf/reward/mine.yaml",
        "conf/experiment/mine.yaml",
    ]
    assert "deepracer-exp train experiment=mine" in ended.stdout
    assert "used as reward.file" in ended.stderr
    assert "mine" in call("train", "--options", "reward").stdout.split()
    cfg = call("train", "experiment=mine", "--cfg").stdout
    assert yaml.safe_load(cfg)["reward"]["file"] == str(tmp_path / "conf/reward/mine.py")


@pytest.mark.parametrize(
    ("text", "word"),
    [("def reward_function(params)\n", "line 1"), ("def reward():\n    pass\n", "no function")],
)
def test_a_reward_function_that_is_none_is_not_imported(call, tmp_path, text, word):
    folder = write_custom_files(tmp_path / "custom_files", text)
    call("import", str(folder), "--name", "mine").assert_bad_input("reward_function.py", word)
    assert not (tmp_path / "conf").exists()


def test_import_of_no_folder_is_bad_input(call):
    call("import", "nowhere", "--name", "mine").assert_bad_input("nowhere", "reward_function.py")
    assert call("import", "nowhere").code == 2


def test_notes_on_imported_files_are_printed_once_and_logged(train_here, tmp_path):
    folder = write_custom_files(tmp_path / "model_3")
    (folder / "hyperparameters.json").write_text(json.dumps({"lr": 1e-4, "stack_size": 1}))
    ended = train_here(f"custom_files={folder}", "budget.iterations=1", "algorithm.episodes_per_iteration=2")
    assert ended.code == 0, ended.stderr
    note = "hyperparameters.json: stack_size=1: not applicable: the service ignores it, too"
    assert ended.stderr.count(note) == 1
    assert note in (ended.folder / "log.txt").read_text()
    assert f"custom_files={folder}" in (ended.folder / "overrides.yaml").read_text()
    assert "model_3" in ended.folder.name
