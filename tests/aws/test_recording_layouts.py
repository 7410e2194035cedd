"""Folders and archives of every layout are read as the same table."""

import json
import os
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.aws.logs.recorded import METRICS_COLUMNS, STEP_COLUMNS, UPDATE_COLUMNS
from deepracer_exp.aws.worlds.routes import world_rows
from deepracer_exp.reports.tables.log_view import prepare
from tests.conftest import refused

from . import made_up_logs as made

LAYOUTS = {
    "drfc_single": made.drfc_single,
    "drfc_workers": made.drfc_workers,
    "drfc_upload": made.drfc_upload,
    "console": made.console,
    "droa": made.droa,
}
EXACT = ("X", "Y", "yaw", "steer", "throttle", "reward", "progress", "track_len", "tstamp")


def written(files: dict[str, str], folder: Path, kind: str) -> Path:
    if kind == "folder":
        return made.write_folder(files, folder / "model")
    return made.write_archive(files, folder / "model.tar.gz")


@pytest.fixture(params=["folder", "archive"])
def place(request, tmp_path):
    return lambda files: written(files, tmp_path, request.param)


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    """Return what is read of a layout in a folder or an archive, read once for all tests."""
    return cache(
        lambda layout, kind: read_recording(written(LAYOUTS[layout](), tmp_path_factory.mktemp(layout), kind))
    )


@pytest.fixture(params=["folder", "archive"])
def recording_of(request, read):
    return lambda layout: read(layout, request.param)


def check_table(table: pd.DataFrame, columns) -> None:
    assert list(table.columns) == list(columns)
    assert {name: str(kind) for name, kind in table.dtypes.items()} == {n: k for n, (k, _) in columns.items()}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_the_same_table_with_every_row_once(recording_of, layout):
    recording = recording_of(layout)
    check_table(recording.steps, STEP_COLUMNS)
    check_table(recording.updates, UPDATE_COLUMNS)
    check_table(recording.metrics, METRICS_COLUMNS)
    assert not recording.problems
    assert recording.name == "model"
    assert len(made.training(recording)) == made.ROWS[layout]
    streams = recording.steps["stream"].unique()
    assert len(set(streams) - {"training"}) == made.EVALUATIONS[layout]
    assert not recording.steps.duplicated(["stream", "episode", "steps"]).any()


@pytest.mark.parametrize("layout", ["drfc_single", "console", "droa"])
def test_the_rows_are_those_that_were_driven_with_all_digits(recording_of, layout):
    rows, wanted = made.training(recording_of(layout)), made.whole_training()
    for name in (*EXACT, "episode", "steps", "done", "all_wheels_on_track", "closest_waypoint", "action"):
        np.testing.assert_array_equal(rows[name], wanted[name])
    np.testing.assert_array_equal(rows["episode_status"].astype(str), wanted["episode_status"])
    np.testing.assert_array_equal(rows["iteration"], wanted["episode"] // 2)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_settings_are_found_in_every_layout_that_has_them(recording_of, layout):
    recording = recording_of(layout)
    assert recording.hyperparameters == made.HYPERPARAMETERS
    assert [tuple(action) for action in recording.metadata.actions] == [(-20.0, 1.0), (20.0, 2.0)]
    if layout != "droa":
        assert recording.reward_source.startswith("def reward_function")
    if layout in ("drfc_single", "console", "droa"):
        assert recording.track == "Oval_track"
        assert set(made.training(recording)["track"]) == {"Oval_track"}


@pytest.mark.parametrize("name", ["ip/hyperparameters.json", "sagemaker.log"])
def test_a_hyperparameter_that_is_not_accepted_is_listed_and_the_others_are_kept(tmp_path, name):
    known = {**made.HYPERPARAMETERS, "exploration_type": "boltzmann", "sac_alpha": 0.3}
    files = made.training_csvs("training-simtrace")
    files[name] = json.dumps(known)
    if name.endswith(".log"):
        files[name] = f"Using the following hyper-parameters\n{json.dumps(known, indent=2)}\n"
    recording = read_recording(made.write_folder(files, tmp_path))
    assert recording.hyperparameters == {**made.HYPERPARAMETERS, "sac_alpha": 0.3}
    (problem,) = recording.problems
    assert 'exploration_type: "boltzmann"; accepted: categorical, e-greedy, additive_noise' in problem.reason


@pytest.mark.parametrize("layout", ["console", "droa"])
def test_policy_updates_stand_with_their_iterations(recording_of, layout):
    updates = recording_of(layout).updates
    assert updates[["iteration", "epoch"]].to_numpy().tolist() == [[i, e] for i in range(3) for e in range(2)]
    assert updates["entropy"].tolist() == [2.0, 2.0, 1.9, 1.9, 1.8, 1.8]
    assert updates["kl"].isna().all()


@pytest.mark.parametrize("layout", ["drfc_single", "drfc_workers", "console", "droa"])
def test_metrics_report_the_episodes_of_the_trace(recording_of, layout):
    recording = recording_of(layout)
    logged = recording.metrics[recording.metrics["stream"] == "training"].set_index("episode")
    driven = made.training(recording).groupby("episode")
    assert sorted(logged.index) == sorted(driven.groups)
    assert (logged["reward"] == driven["reward"].sum().astype(int)[logged.index]).all()
    for name in ("worker", "iteration"):
        assert (logged[name] == driven[name].first()[logged.index]).all()
    assert set(logged["episode_status"]) == {"lap_complete"}
    if layout != "drfc_workers":
        evaluated = recording.metrics[recording.metrics["stream"] != "training"].iloc[0]
        assert evaluated["stream"] in set(recording.steps["stream"])
        assert (evaluated["phase"], evaluated["episode"], evaluated["resets"]) == ("evaluation", 0, 1)


def test_each_worker_has_the_track_of_its_own_configuration(tmp_path):
    files = made.drfc_workers()
    for number, world in ((1, "Oval_track"), (2, "Bowtie_track")):
        files[f"training_params_{number}.yaml"] = f"WORLD_NAME: {world}\n"
    recording = read_recording(made.write_folder(files, tmp_path))
    driven = made.training(recording).groupby("worker")["track"].agg(lambda names: set(map(str, names)))
    assert driven.tolist() == [{"Oval_track"}, {"Bowtie_track"}]
    # The page of one track counts no episode of the other, not those of metrics files either.
    view = prepare(recording, "Bowtie_track")
    assert set(view.steps["worker"]) == set(view.recording.metrics["worker"]) == {1}


def test_the_parameters_of_the_last_evaluation_name_no_other_world_of_an_earlier_one(tmp_path):
    files = made.drfc_single()
    for day, world in ((2, "Bowtie_track"), (3, "Oval_track")):
        waypoints = world_rows(world)[:6, :2]
        lap = made.drives([0], seed=50 + day).assign(
            X=waypoints[:, 0], Y=waypoints[:, 1], closest_waypoint=np.arange(6), track_len=10.0 + day
        )
        files[f"evaluation-2024010{day}101010/evaluation-simtrace/0-iteration.csv"] = made.csv_text(lap)
    files["evaluation_params.yaml"] = "WORLD_NAME: Oval_track\n"
    steps = read_recording(made.write_folder(files, tmp_path)).steps
    named = steps[steps["stream"] != "training"].groupby("stream", observed=True)["track"].first()
    # The course of the first one, with points at random, is none of the service's.
    assert named.astype(str).tolist() == ["", "Bowtie_track", "Oval_track"]


def test_episodes_of_several_workers_are_numbered_by_iteration_and_worker(recording_of):
    rows = made.training(recording_of("drfc_workers"))
    of = rows.groupby("episode")[["iteration", "worker"]].first()
    assert of.to_numpy().tolist() == [[i, w] for i in range(3) for w in (0, 0, 1, 1)]
    assert rows["iteration"].is_monotonic_increasing


@pytest.mark.parametrize("how", ["files", "one after the other", "line by line"])
def test_text_logs_of_several_workers_are_one_training_with_the_iterations_of_its_checkpoints(tmp_path, how):
    tags = [f"robomaker.{worker + 1}.ab{worker}@host    | " for worker in range(3)]
    texts = [
        made.worker_text(worker, tag=tags[worker] if how == "line by line" else "") for worker in range(3)
    ]
    if how == "files":
        for worker, text in enumerate(texts):
            (tmp_path / f"deepracer-0_robomaker.{worker + 1}.ab{worker}c.log").write_text(text)
    elif how == "one after the other":
        (tmp_path / "all.log").write_text("".join(texts))
    else:
        mixed = zip(*(text.splitlines(keepends=True) for text in texts), strict=True)
        (tmp_path / "all.log").write_text("".join(one for lines in mixed for one in lines))
    recording = read_recording(tmp_path)
    rows = made.training(recording)
    of = rows.groupby("episode")[["iteration", "worker"]].first()
    assert of.to_numpy().tolist() == [[i, w] for i in (308, 309) for w in (0, 0, 1, 1, 2, 2)]
    assert recording.checkpoints == {308: "308_Step-0", 309: "309_Step-24"}
    assert not recording.rounds
    assert not recording.problems


def test_jobs_in_one_place_that_began_with_other_checkpoints_are_trainings_of_their_own(tmp_path):
    for number, first in enumerate((10, 12)):
        (tmp_path / f"robomaker.1.{number}.log").write_text(made.worker_text(0, first, seed=first))
        (tmp_path / f"robomaker.2.{number}.log").write_text(made.worker_text(1, first, seed=first))
    recording = read_recording(tmp_path)
    assert [one.first_iteration for one in recording.rounds] == [10, 12]
    assert sorted(recording.checkpoints) == [10, 11, 12, 13]
    assert set(made.training(recording)["worker"]) == {0, 1}


@pytest.mark.parametrize("names", [("a", "b"), ("20220101", "20220111")])
def test_logs_of_workers_with_one_name_are_one_training_and_of_two_names_two(tmp_path, names):
    for number, name in enumerate(names):
        for worker in range(2):
            rows = made.drives([0, 1], seed=10 * number + worker)
            (tmp_path / f"worker_{worker}-{name}.log").write_text(made.log_text(rows))
    recording = read_recording(tmp_path)
    assert [one.name.rpartition("/")[2] for one in recording.rounds] == [f"worker_#-{name}" for name in names]
    of = made.training(recording).groupby("episode")[["iteration", "worker"]].first()
    assert of.to_numpy().tolist() == [[i, w] for i in (0, 1) for w in (0, 0, 1, 1)]
    (tmp_path / f"worker_0-{names[1]}.log").unlink()
    (tmp_path / f"worker_1-{names[1]}.log").unlink()
    assert not read_recording(tmp_path).rounds


def test_checkpoints_of_a_clone_count_the_iterations_of_its_csvs(tmp_path):
    files = made.training_csvs("training-simtrace", iterations=2)
    files["logs/training/x-robomaker.log"] = made.worker_text(0, first=50)
    files["logs/training/x-sagemaker.log"] = made.trainer_text(2) + "".join(
        f"Checkpoint> Saving in path=['./agent/{number}_Step-{24 * (number - 50)}.ckpt']\n"
        for number in (50, 51, 52)
    )
    recording = read_recording(made.write_folder(files, tmp_path))
    assert set(made.training(recording)["iteration"]) == {50, 51}
    assert recording.checkpoints == {50: "50_Step-0", 51: "51_Step-24", 52: "52_Step-48"}
    assert set(recording.updates["iteration"]) == {50, 51}


def test_races_that_begin_with_the_same_rows_are_both_kept(tmp_path):
    race, other = made.drives([0], seed=60, steps=12), made.drives([0], seed=61, steps=12)
    begin = ["X", "Y", "tstamp"]
    other.loc[:2, begin] = race.loc[:2, begin]
    files = {
        f"logs/leaderboard/leaderboard-2024020210101{number}-XyZ{number}-robomaker.log": made.log_text(rows)
        for number, rows in enumerate((race, other))
    }
    recording = read_recording(made.write_folder(files, tmp_path))
    assert recording.steps["stream"].nunique() == 2
    assert len(recording.steps) == 24
    assert not recording.problems


def test_an_iteration_of_the_log_alone_is_used_though_the_job_ended_within_its_last_episode(tmp_path):
    drives = [made.drives(range(4 * number, 4 * number + 4), seed=number + 1) for number in range(3)]
    files = {f"training-simtrace/{number}-iteration.csv": made.csv_text(drives[number]) for number in (0, 1)}
    lines = []
    for number, rows in enumerate((*drives[:2], drives[2].iloc[:-3])):
        lines.append(f"Checkpoint> Restoring from path=./agent/{number}_Step-{24 * number}.ckpt")
        lines += [made.line(row) for row in rows.itertuples()]
    files["logs/training/x-robomaker.log"] = "\n".join(lines) + "\n"
    recording = read_recording(made.write_folder(files, tmp_path))
    assert made.training(recording).groupby("iteration")["episode"].nunique().tolist() == [4, 4, 4]
    assert not recording.problems


def test_metrics_report_the_iterations_of_episodes_whose_traces_are_missing(place):
    files = made.drfc_single()
    for number in (0, 2):
        del files[f"training-simtrace/{number}-iteration.csv"]
    items = json.loads(files["metrics/TrainingMetrics.json"])
    for number, item in enumerate(items["metrics"]):
        item["trial"] = number % 2 + 1
    files["metrics/TrainingMetrics.json"] = json.dumps(items)
    recording = read_recording(place(files))
    logged = recording.metrics[recording.metrics["stream"] == "training"]
    assert set(made.training(recording)["iteration"]) == {1}
    assert logged["iteration"].tolist() == [0, 0, 1, 1, 2, 2]


def test_clones_continue_where_the_one_before_ended(place):
    files = {}
    for number, name in enumerate(("first", "first-1", "first-2", "first-10")):
        files |= made.training_csvs(f"{name}/training-simtrace", iterations=2, seed=5 * number + 1)
        files[f"{name}/logs/sagemaker.log"] = made.trainer_text(2)
        files[f"{name}/metrics/TrainingMetrics.json"] = made.training_metrics(
            made.whole_training(2, 5 * number + 1)
        )
    recording = read_recording(place(files))
    rows = made.training(recording)
    assert rows["iteration"].unique().tolist() == list(range(8))
    assert rows["episode"].unique().tolist() == list(range(16))
    assert [Path(one.name).name for one in recording.rounds] == ["first", "first-1", "first-2", "first-10"]
    assert [one.first_iteration for one in recording.rounds] == [0, 2, 4, 6]
    assert recording.updates["iteration"].unique().tolist() == list(range(8))
    reward = rows.groupby("episode")["reward"].sum().astype(int)
    assert (recording.metrics.set_index("episode")["reward"] == reward).all()


def test_iterations_that_are_in_the_log_only_are_added_that_which_the_job_ended_in_among_them(place):
    files = made.console()
    del files["sim-trace/training/training-simtrace/1-iteration.csv"]
    name = next(name for name in files if "training" in name and name.endswith("robomaker.log"))
    more = made.drives([6, 7], seed=4).iloc[:9]
    files[name] = "".join(made.trainer_text(3)) + made.log_text(pd.concat([made.whole_training(), more]))
    recording = read_recording(place(files))
    rows = made.training(recording)
    assert len(rows) == 36 + 9
    assert rows["iteration"].tolist() == (np.arange(45) // 12).tolist()
    driven = pd.concat([made.whole_training(), more])
    np.testing.assert_allclose(rows["X"], driven["X"], rtol=0, atol=6e-5)
    assert recording.problems == ()


def test_a_rolled_log_is_read_in_the_order_of_its_episodes(tmp_path):
    rows = made.whole_training()
    for name, part in (("a.log.2", rows[:15]), ("a.log.1", rows[15:25]), ("a.log", rows[25:])):
        (tmp_path / name).write_text(made.log_text(part))
    steps = read_recording(tmp_path).steps
    np.testing.assert_array_equal(steps["tstamp"], rows["tstamp"])
    assert steps["episode"].tolist() == rows["episode"].tolist()


def test_pieces_of_a_rolled_trainers_log_continue_the_iterations(tmp_path):
    text = made.trainer_text(4).splitlines(keepends=True)
    cut = next(at for at, line in enumerate(text) if "training epoch=1" in line and "1.900" in line)
    (tmp_path / "a-sagemaker.log.1").write_text("".join(text[:cut]))
    (tmp_path / "a-sagemaker.log").write_text("".join(text[cut:]))
    updates = read_recording(tmp_path).updates
    assert updates["iteration"].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert updates["entropy"].tolist() == [2.0, 2.0, 1.9, 1.9, 1.8, 1.8, 1.7, 1.7]


@pytest.mark.parametrize(
    "name", ["3-iteration.csv", "drives.csv", "evaluation-20240101101010-x-robomaker.log", "log"]
)
def test_a_single_file_is_enough(tmp_path, name):
    rows = made.drives([6, 7])
    file = tmp_path / name
    file.write_text(made.csv_text(rows) if name.endswith(".csv") else made.log_text(rows))
    steps = read_recording(file).steps
    assert len(steps) == 12
    assert set(steps["stream"]) == {"evaluation-20240101101010-x" if "evaluation" in name else "training"}
    assert set(steps["iteration"]) == ({3} if "3-" in name else {0})


def test_the_same_file_twice_is_read_once_and_reported(tmp_path):
    text = made.csv_text(made.drives([0, 1]))
    (tmp_path / "0-iteration.csv").write_text(text)
    (tmp_path / "0-iteration (copy).csv").write_text(text)
    recording = read_recording(tmp_path)
    assert len(recording.steps) == 12
    (problem,) = recording.problems
    assert (problem.lines, "there twice" in problem.reason) == (12, True)


def test_links_are_not_followed(tmp_path):
    outside = made.write_folder(made.training_csvs("training-simtrace"), tmp_path / "outside")
    inside = made.write_folder(made.drfc_upload(), tmp_path / "inside")
    (inside / "training-simtrace").symlink_to(outside / "training-simtrace")
    recording = read_recording(inside)
    assert set(recording.steps["stream"]) == {"evaluation-20240101101010"}
    assert [problem.reason for problem in recording.problems] == ["a link; not followed"]


@pytest.mark.parametrize("name", ["3-iteration.csv", "a-robomaker.log", "week.tar.gz", "week.zip"])
def test_a_link_that_the_user_names_is_read_by_its_own_name(tmp_path, name):
    blob = tmp_path / "blobs" / "1f0c"
    blob.parent.mkdir()
    csv = {"training-simtrace/3-iteration.csv": made.csv_text(made.drives([6, 7]))}
    if name.startswith("week"):
        (made.write_zip if name.endswith("zip") else made.write_archive)(csv, blob)
    else:
        blob.write_text(
            made.csv_text(made.drives([6, 7])) if "csv" in name else made.log_text(made.drives([6, 7]))
        )
    link = tmp_path / name
    link.symlink_to(blob)
    recording = read_recording(link)
    assert len(recording.steps) == 12
    assert recording.name == name.removesuffix(".tar.gz").removesuffix(".zip")
    assert set(recording.steps["iteration"]) == ({0} if name.endswith(".log") else {3})


@pytest.mark.parametrize(
    ("settings", "kind"), [(["/LEADERBOARD_TYPE: COMMUNITY"], "leaderboard"), ([], "evaluation")]
)
def test_a_race_is_no_training_whatever_its_log_is_called(tmp_path, settings, kind):
    text = "".join(f" * {line}\n" for line in ["/NUMBER_OF_TRIALS: 3", *settings]) + made.log_text(
        made.drives([0])
    )
    (tmp_path / "robomaker.log").write_text(text)
    recording = read_recording(tmp_path / "robomaker.log")
    assert set(recording.steps["stream"]) == {"robomaker"}
    assert not recording.checkpoints
    # Beside a training it is an evaluation of it, and its rows are no iteration.
    made.write_folder(made.drfc_single(), tmp_path)
    both = read_recording(tmp_path)
    assert len(made.training(both)) == made.ROWS["drfc_single"]
    assert "robomaker" in set(both.steps["stream"])


def test_numbers_of_the_logs_of_2019_are_no_iterations(tmp_path):
    for number in range(12):
        rows = made.drives([2 * number, 2 * number + 1], seed=number)
        (tmp_path / f"sim-trace-log-{number}.log").write_text(made.log_text(rows, 15))
    recording = read_recording(tmp_path)
    assert not recording.rounds
    steps = recording.steps
    assert (steps["iteration"] == steps["episode"] // 20).all()
    # Lines that an evaluation's log repeats are the training's, whatever else is in it.
    for episodes in ([2, 3], [2, 3, 40]):
        again = pd.concat(
            [
                made.drives([number], seed=99)
                if number == 40
                else made.drives([2, 3], seed=1).query("episode == @number")
                for number in episodes
            ]
        )
        (tmp_path / "evaluation-sim-trace-log.log").write_text(made.log_text(again, 15))
        both = read_recording(tmp_path)
        assert not both.problems
        assert made.training(both)["X"].tolist() == steps["X"].tolist()
        assert len(both.steps) - len(steps) == 6 * episodes.count(40)
    (tmp_path / "evaluation-sim-trace-log.log").unlink()
    # Those whose episodes begin anew are trainings of their own.
    (tmp_path / "sim-trace-log-12.log").write_text(made.log_text(made.drives([0, 1], seed=12), 15))
    assert len(read_recording(tmp_path).rounds) > 1


def test_the_trainers_own_table_of_each_worker_is_no_trace(tmp_path):
    made.write_folder(made.drfc_single(), tmp_path)
    (tmp_path / "worker_0.simple_rl_graph.main_level.main_level.agent_0.csv").write_text(
        "Episode #,Loss\n1,0\n"
    )
    assert not read_recording(tmp_path).problems


def test_folders_may_be_named_by_their_workers(tmp_path):
    plain = made.write_folder(made.drfc_workers(), tmp_path / "plain")
    named = {
        name.replace("0/", "worker_0/").replace("1/", "worker_1/"): text
        for name, text in made.drfc_workers().items()
    }
    folders = made.write_folder(named, tmp_path / "named")
    assert set(read_recording(folders).steps["worker"]) == {0, 1}
    for table in ("steps", "metrics"):
        assert getattr(read_recording(folders), table).equals(getattr(read_recording(plain), table))
    for worker in range(2):
        rows = made.drives([0, 1], seed=worker)
        made.write_folder({f"worker_{worker}/robomaker.log": made.log_text(rows)}, tmp_path / "text")
    steps = read_recording(tmp_path / "text").steps
    assert sorted(set(zip(steps["worker"], steps["episode"], strict=True))) == [
        (0, 0),
        (0, 1),
        (1, 2),
        (1, 3),
    ]


def test_a_name_that_is_no_utf_8_can_be_shown(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/tr\xff\x1b[31m"))
    folder.mkdir()
    (folder / "robomaker.log").write_text(made.log_text(made.drives([0])) + "SIM_TRACE_LOG:1\n")
    recording = read_recording(folder)
    assert len(recording.steps) == 6
    logged = [recording.name, *map(str, recording.problems), *recording.steps["stream"].unique()]
    assert "tr\N{REPLACEMENT CHARACTER}\N{REPLACEMENT CHARACTER}[31m" in "".join(logged)
    assert "".join(logged).isprintable()


def test_nothing_readable_is_refused_in_one_line(tmp_path):
    (tmp_path / "empty").mkdir()
    made.write_folder({"notes/shopping.csv": "milk,eggs\n1,2\n"}, tmp_path)
    (tmp_path / "no.tar.gz").write_bytes(b"\x1f\x8b no archive")
    for name in ("absent", "empty", "notes", "notes/shopping.csv", "no.tar.gz"):
        assert refused(read_recording, tmp_path / name).startswith(str(tmp_path / name))


def test_unrelated_files_are_named(tmp_path):
    unrelated = {"invoice.docx": "PK", "prices.csv": "milk,eggs\n1,2\n", "other.json": "[1, 2]"}
    recording = read_recording(made.write_folder(made.drfc_single() | unrelated, tmp_path))
    assert len(made.training(recording)) == 36
    logged = "\n".join(map(str, recording.problems))
    for name in unrelated:
        assert name in logged
