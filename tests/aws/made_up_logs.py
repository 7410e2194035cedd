"""Made-up drives, and the folders in which the service would leave them."""

import io
import json
import tarfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from deepracer_exp.aws.logs.recorded import Recording
from deepracer_exp.runs.recording import read_run_recording

COMMON = (
    *("episode", "steps", "X", "Y", "yaw", "steer", "throttle", "action", "reward", "done"),
    *("all_wheels_on_track", "progress", "closest_waypoint", "track_len", "tstamp"),
)
LATER = ("episode_status", "pause_duration", "obstacle_crash_counter", "wall_clock")
FIELDS = {
    15: COMMON,
    16: (*COMMON, LATER[0]),
    17: (*COMMON, *LATER[:2]),
    18: (*COMMON, LATER[0], LATER[1], LATER[3]),
    19: (*COMMON, *LATER),
}
HYPERPARAMETERS = {"batch_size": 64, "discount_factor": 0.95, "num_episodes_between_training": 2}
METADATA = {
    "action_space": [{"steering_angle": -20, "speed": 1.0}, {"steering_angle": 20, "speed": 2.0}],
    "sensor": ["FRONT_FACING_CAMERA"],
    "version": "4",
}
ROWS = {"drfc_single": 36, "drfc_workers": 72, "drfc_upload": 0, "console": 36, "droa": 36}
EVALUATIONS = {"drfc_single": 1, "drfc_workers": 0, "drfc_upload": 1, "console": 2, "droa": 1}
"""Of each layout: steps of the training, and number of evaluations."""


def drives(episodes: Sequence[int], seed: int = 0, steps: int = 6) -> pd.DataFrame:
    """Return the steps of some episodes, all columns of the newest generation."""
    rng = np.random.default_rng(seed)
    rows = len(episodes) * steps
    step = np.tile(np.arange(1, steps + 1), len(episodes))
    return pd.DataFrame(
        {
            "episode": np.repeat(episodes, steps),
            "steps": step,
            "X": rng.uniform(-5, 5, rows),
            "Y": rng.uniform(-5, 5, rows),
            "yaw": rng.uniform(-180, 180, rows),
            "steer": rng.choice([-20.0, 20.0], rows),
            "throttle": rng.choice([1.0, 2.0], rows),
            "action": rng.integers(0, 2, rows),
            "reward": rng.uniform(0, 1, rows),
            "done": step == steps,
            "all_wheels_on_track": rng.random(rows) < 0.9,
            "progress": step * 100.0 / steps,
            "closest_waypoint": step,
            "track_len": 17.71,
            "tstamp": 100.0 * seed + np.round(np.arange(rows) / 15, 3),
            "episode_status": np.where(
                step == 1, "prepare", np.where(step == steps, "lap_complete", "in_progress")
            ),
            "pause_duration": 0.0,
            "obstacle_crash_counter": 0,
            "wall_clock": 1.7e9 + np.arange(rows) / 10,
        }
    )


def csv_text(rows: pd.DataFrame, fields: int = 17) -> str:
    """Return the CSV of a generation."""
    names = list(FIELDS[fields]) if fields != 18 else [*COMMON, *LATER[:3]]
    return rows.assign(steps=rows["steps"].astype(float))[names].to_csv(index=False)


def line(row: object, fields: int = 17, prefix: str = "") -> str:
    """Return the line of a text log, rounded as the service does."""
    digits = {"X": 4, "Y": 4, "yaw": 4, "steer": 2, "throttle": 2, "reward": 4, "progress": 4, "track_len": 2}
    digits |= {"pause_duration": 2, "wall_clock": 4}
    values = []
    for name in FIELDS[fields]:
        value = getattr(row, name)
        values.append(f"{value:.{digits[name]}f}" if name in digits else str(value))
    return f"{prefix}SIM_TRACE_LOG:{','.join(values)}"


def log_text(rows: pd.DataFrame, fields: int = 17, prefix: str = "", world: str = "Oval_track") -> str:
    """Return the log of a simulation."""
    head = [f"{prefix} * /WORLD_NAME: {world}", f"{prefix}some node says something"]
    return (
        "\n".join([*head, *(line(row, fields, prefix) for row in rows.itertuples()), f"{prefix}bye"]) + "\n"
    )


def worker_text(worker: int, first: int = 308, tag: str = "", iterations: int = 2, seed: int = 1) -> str:
    """Return the log of one of several simulation workers: two episodes with each checkpoint."""
    lines = [f"+ python3 -m markov.rollout_worker --rollout_idx {worker}", "S3 prefix: my-model", ""]
    for number in range(iterations):
        lines.append(f"Checkpoint> Restoring from path=./agent/{first + number}_Step-{number * 24}.ckpt")
        rows = drives([2 * number, 2 * number + 1], seed=10 * worker + number + seed)
        lines += [line(row) for row in rows.itertuples()]
    return "".join(f"{tag}{one}\n" for one in lines)


def trainer_text(iterations: int, epochs: int = 2, first: int = 0, per_iteration: int = 2) -> str:
    """Return the log of a trainer."""
    lines = ["Using the following hyper-parameters", json.dumps(HYPERPARAMETERS, indent=2)]
    lines.append(f"Action space from file: {METADATA['action_space']}")
    for iteration in range(first, first + iterations):
        episodes = range(iteration * per_iteration + 1, (iteration + 1) * per_iteration + 1)
        lines += [
            f"Training> Name=main_level/agent, Worker=0, Episode={episode}, Total reward=0, Steps={episode * 6}, "
            f"Training iteration={iteration}"
            for episode in episodes
        ]
        lines += [
            f"Policy training> Surrogate loss=-0.1, KL divergence=nan, Entropy={2 - 0.1 * iteration:.3f}, "
            f"training epoch={epoch}, learning_rate=0.0003"
            for epoch in range(epochs)
        ]
    return "\n".join(lines) + "\n"


def training_metrics(rows: pd.DataFrame) -> str:
    """Return the metrics of a training."""
    items = [
        {
            "reward_score": int(of["reward"].sum()),
            "elapsed_time_in_milliseconds": int(1000 * (of["tstamp"].max() - of["tstamp"].min())),
            "episode": int(episode) + 1,
            "trial": 1,
            "phase": "training",
            "completion_percentage": 100,
            "episode_status": "Lap complete",
        }
        for episode, of in rows.groupby("episode")
    ]
    return json.dumps({"metrics": items, "version": 2.0})


def evaluation_metrics() -> str:
    """Return the metrics of an evaluation of one lap."""
    item = {
        "completion_percentage": 100,
        "elapsed_time_in_milliseconds": 333,
        "episode_status": "Lap complete",
    }
    return json.dumps({"metrics": [{**item, "reset_count": 1, "trial": 1}]})


def settings(model: str = "model/model_metadata.json") -> dict[str, str]:
    """Return the files beside the drives in every model folder."""
    return {
        model: json.dumps(METADATA),
        "ip/hyperparameters.json": json.dumps(HYPERPARAMETERS),
        "reward_function.py": "def reward_function(params):\n    return 1.0\n",
    }


def training_csvs(
    folder: str, iterations: int = 3, first: int = 0, seed: int = 1, fields: int = 17
) -> dict[str, str]:
    """Return the CSVs of a training, two episodes an iteration."""
    return {
        f"{folder}/{n}-iteration.csv": csv_text(drives([2 * n, 2 * n + 1], seed=seed + n), fields)
        for n in range(first, first + iterations)
    }


def whole_training(iterations: int = 3, seed: int = 1) -> pd.DataFrame:
    """Return the rows of `training_csvs`."""
    return pd.concat(
        [drives([2 * n, 2 * n + 1], seed=seed + n) for n in range(iterations)], ignore_index=True
    )


def drfc_single() -> dict[str, str]:
    """Return a model folder of deepracer-for-cloud with one worker."""
    return {
        **training_csvs("training-simtrace"),
        "evaluation-20240101101010/evaluation-simtrace/0-iteration.csv": csv_text(drives([0], seed=50)),
        "metrics/TrainingMetrics.json": training_metrics(whole_training()),
        "metrics/EvaluationMetrics-20240101101010.json": evaluation_metrics(),
        "training_params.yaml": "WORLD_NAME: Oval_track\n",
        **settings(),
    }


def drfc_workers() -> dict[str, str]:
    """Return a model folder of deepracer-for-cloud with two workers; each counts its own episodes."""
    files = settings()
    for worker in range(2):
        files |= training_csvs(f"{worker}/training-simtrace", seed=10 * worker + 1)
        name = "TrainingMetrics.json" if not worker else f"TrainingMetrics_{worker}.json"
        files[f"metrics/{name}"] = training_metrics(whole_training(seed=10 * worker + 1))
    return files


def drfc_upload() -> dict[str, str]:
    """Return an uploaded model with an evaluation and no training."""
    return {
        **settings(),
        "evaluation-20240101101010/evaluation-simtrace/0-iteration.csv": csv_text(drives([0], seed=50)),
    }


def console() -> dict[str, str]:
    """Return an archive of the AWS console: everything is there as CSV and as text, but for the race."""
    job, other = "20240101101010-AbC-d", "20240101111111-AbC-d"
    return {
        **training_csvs("sim-trace/training/training-simtrace"),
        f"sim-trace/evaluation/{job}/evaluation-simtrace/0-iteration.csv": csv_text(drives([0], seed=50)),
        f"logs/training/training-{job}-robomaker.log": log_text(whole_training()),
        f"logs/training/training-{job}-sagemaker.log": trainer_text(3),
        f"logs/evaluation/evaluation-{other}-robomaker.log": log_text(drives([0], seed=50)),
        "logs/leaderboard/leaderboard-20240202101010-XyZ-robomaker.log": log_text(drives([0], seed=60)),
        f"metrics/training/training-{job}.json": training_metrics(whole_training()),
        f"metrics/evaluation/evaluation-{job}.json": evaluation_metrics(),
        **settings("model_metadata.json"),
    }


def droa() -> dict[str, str]:
    """Return an archive of DeepRacer on AWS: folders with time stamps, 19 values, lines with the nodes' names."""
    job, evaluated = "2026-03-06T18:33:59.511Z-me-training-ACG", "2026-03-07T17:52:00.898Z-me-evaluation-9oJ"
    later = "2026-03-06T20:36:57.936Z-me-training-ACG"
    prefix = "[download_node-1] [agent-9] "
    return {
        **training_csvs(f"sim-trace/training/{job}/training-simtrace", fields=19),
        f"sim-trace/evaluation/{evaluated}/evaluation-simtrace/0-iteration.csv": csv_text(
            drives([0], seed=50), 19
        ),
        f"logs/training/{later}-simulation.log": log_text(whole_training(), 19, prefix),
        f"logs/training/{later}-training.log": trainer_text(3),
        f"metrics/training/{job}.json": training_metrics(whole_training()),
        f"metrics/evaluation/{evaluated}.json": evaluation_metrics(),
    }


def write_folder(files: dict[str, str], folder: Path) -> Path:
    """Write the files."""
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def write_archive(files: dict[str, str], path: Path) -> Path:
    """Write the files as a tar.gz below one folder, in no helpful order."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(path, "w:gz") as archive:
        for name in sorted(files, key=lambda name: name[::-1]):
            add_member(archive, f"model/{name}", files[name].encode())
    return path


def write_zip(files: dict[str, str], path: Path) -> Path:
    """Write the files as a zip archive."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(f"model/{name}", text)
    return path


def add_member(archive: tarfile.TarFile, name: str, raw: bytes) -> None:
    """Add a file to an archive."""
    member = tarfile.TarInfo(name)
    member.size = len(raw)
    archive.addfile(member, io.BytesIO(raw))


def training(recording: Recording) -> pd.DataFrame:
    """Return the steps of the training."""
    return recording.steps[recording.steps["stream"] == "training"]


def write_run_as_logs(run_dir: Path, folder: Path, world: str) -> Path:
    """Write the whole episodes of a run of ours with discrete actions as one training log of the service."""
    steps = read_run_recording(run_dir).recording.steps.sort_values(["episode", "steps"])
    steps = steps[steps.groupby("episode")["done"].transform("any")].astype({"action": int})
    folder.mkdir(parents=True)
    (folder / "training-robomaker.log").write_text(log_text(steps, world=world))
    return folder
