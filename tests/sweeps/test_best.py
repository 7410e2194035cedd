import json
import shlex
import shutil
from pathlib import Path

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.best_run import best_run_of_sweep, read_best_of_sweep
from deepracer_exp.runs.run_files import BEST_OF_SWEEP
from deepracer_exp.sweeps.report.best_trial import (
    best_line,
    best_run,
    best_trial,
    best_values,
    complete_trials,
    write_best,
)
from deepracer_exp.sweeps.trial import SeedRun
from deepracer_exp.tracking.resolve import resolve
from tests.conftest import refused

from .studies import add, fresh_laps, new_study, write_metrics


@pytest.mark.parametrize(
    ("objectives", "values", "order"),
    [
        (["race_score"], [[11.0], [9.0], [10.0]], [1, 2, 0]),
        (["completion"], [[80.0], [95.0], [90.0]], [1, 2, 0]),
        # A fast car that rarely finishes is not the best.
        (["lap_time", "completion"], [(8.0, 40.0), (9.0, 98.0), (11.0, 100.0), (60.0, 0.0)], [1, 2, 0, 3]),
    ],
)
def test_the_best_of_the_complete_trials_wins_and_a_pruned_one_never(tmp_path, objectives, values, order):
    study = new_study(tmp_path, objectives=objectives)
    for one in values:
        add(study, one)
    add(study, None, "median", seen=1.0 if len(objectives) == 1 else None)
    assert [trial.number for trial in complete_trials(study)] == order
    assert (best_trial(study).number, best_values(study)) == (1, list(values[1]))


def test_on_fresh_laps_another_trial_may_win(tmp_path):
    study = new_study(tmp_path)
    for score in (9.0, 9.1, 12.0):
        add(study, [score])
    study.set_user_attr("reranked", [fresh_laps(0, 9.8), fresh_laps(1, 9.3)])
    assert (best_trial(study).number, best_values(study)) == (1, [9.3])
    study.set_user_attr("reranked_of", 3)
    assert (best_trial(study).number, best_values(study)) == (1, [9.3])
    # Trials made since may be better, and have driven no fresh laps.
    add(study, [8.0])
    assert (best_trial(study).number, best_values(study)) == (3, [8.0])


def test_without_a_complete_trial_there_is_no_best(tmp_path):
    study = new_study(tmp_path)
    add(study, None, "collapsed")
    with pytest.raises(BadInput, match="none of its 1 trials is complete"):
        best_line(study)


def test_the_command_names_the_threads_on_which_a_networks_last_digits_depend(tmp_path):
    study = new_study(tmp_path)
    where = ["collector.mode=in_process", "collector.processes=null", "collector.threads=1"]
    add(study, [9.0], overrides=["observation=camera_small"], where=where)
    words = shlex.split(best_line(study))
    assert words == ["deepracer-exp", "train", "observation=camera_small", *where]
    collector = compose_experiment(words[2:])[0].collector
    assert (collector.mode, collector.processes, collector.threads) == ("in_process", None, 1)


def test_a_shell_reads_every_override_back_from_the_command(tmp_path):
    study = new_study(tmp_path)
    overrides = ["algorithm.lr=0.0003", "network.hidden=[64, 64]", "reward.constants.NAME=it's <a> $HOME"]
    add(study, [9.0], overrides=overrides)
    assert shlex.split(best_line(study)) == ["deepracer-exp", "train", *overrides]
    study.set_user_attr("parent", "best:spring")
    study.set_user_attr("parent_run", {"run_dir": "/my runs/a", "checkpoint": 40})
    cloned = ["deepracer-exp", "clone", "/my runs/a", "checkpoint=40", *overrides]
    assert shlex.split(best_line(study)) == cloned


def with_runs(study, values):
    """Add a trial with a run a seed."""
    base = Path(study.user_attrs["runs_dir"]) / study.study_name
    runs = []
    for seed, value in enumerate(values):
        run_dir = base / f"seed-{seed}"
        write_metrics(run_dir, 2)
        runs.append(SeedRun(seed=seed, run_dir=str(run_dir), status="finished", values=value))
    add(study, [sum(value[0] for value in values) / len(values)], runs=tuple(runs))


def test_with_several_seeds_the_command_trains_with_that_of_the_best_run(tmp_path):
    study = new_study(tmp_path / "runs", seeds=3)
    with_runs(study, ([10.0], [9.0], [9.5]))
    best = best_run(study)
    (best / "config.yaml").write_text("seed: 41\n")
    assert shlex.split(best_line(study))[-1] == "seed=41"
    shutil.rmtree(best)
    assert not any(word.startswith("seed=") for word in shlex.split(best_line(study)))


def test_the_best_run_is_that_of_the_best_seed_wherever_all_runs_have_moved(tmp_path):
    study = new_study(tmp_path / "runs")
    with_runs(study, ([10.0], [9.0], [9.5]))
    assert best_run(study) == tmp_path / "runs" / "lr_entropy" / "seed-1"
    (tmp_path / "runs").rename(tmp_path / "moved")
    with pytest.raises(BadInput, match="is gone"):
        best_run(study)
    assert best_run(study, tmp_path / "moved").parents[1] == tmp_path / "moved"


def test_best_of_a_study_leads_to_the_run_of_its_best_trial(tmp_path):
    study = new_study(tmp_path)
    with_runs(study, ([10.0], [9.0]))
    folder = tmp_path / "lr_entropy"
    # Something faster, trained by hand under the same name, was never compared with the trials.
    (folder / "by-hand" / "checkpoints" / "best").mkdir(parents=True)
    (folder / "by-hand" / "config.yaml").write_text("name: lr_entropy\n")
    best = {"iteration": 1, "metric": "x", "rank": [1, 1], "eval_completion": 100.0, "eval_lap_time_s": 1.0}
    (folder / "by-hand" / "summary.json").write_text(json.dumps({"best": best}))
    assert resolve("best:lr_entropy", tmp_path, None).path == folder / "by-hand"
    write_best(study, tmp_path)
    assert resolve("best:lr_entropy", tmp_path, None).path == folder / "seed-1"
    best = read_best_of_sweep(folder)
    assert best is not None
    assert (best.study, best.trial, best.values) == ("lr_entropy", 0, {"race_score": 9.5})


ELSEWHERE = ["../elsewhere", "/etc", "..", ".", "", "a/b", "a\\b", "seed-0\n", 3, None]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        *(
            (json.dumps({"study": "s", "trial": 0, "run_dir": name, "values": {}}), "run_dir")
            for name in ELSEWHERE
        ),
        *((text, BEST_OF_SWEEP) for text in ("", "[]", "{", '{"study": "x"}', '{"study": "x", "trial": -1}')),
        ('{"study": "s", "trial": 7, "run_dir": "gone", "values": {}}', "run gone of trial 7 is gone"),
        ('{"study": "s", "trial": 0, "run_dir": "link", "values": {}}', "leads out of"),
    ],
)
def test_a_file_that_leads_to_no_run_of_the_sweep_is_refused_in_one_line(tmp_path, text, words):
    write_metrics(tmp_path / "elsewhere", 1)
    folder = tmp_path / "study"
    folder.mkdir()
    assert best_run_of_sweep(folder) is None
    (folder / "link").symlink_to(tmp_path / "elsewhere")
    (folder / BEST_OF_SWEEP).write_text(text)
    assert words in refused(best_run_of_sweep, folder)
