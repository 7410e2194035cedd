"""The files of a DeepRacer model, as deepracer-for-cloud has them."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.experiment import Experiment

HYPERPARAMETERS = {
    "batch_size": 64,
    "beta_entropy": 0.01,
    "discount_factor": 0.99,
    "e_greedy_value": 0.05,
    "epsilon_steps": 10000,
    "exploration_type": "categorical",
    "loss_type": "huber",
    "lr": 0.0003,
    "num_episodes_between_training": 20,
    "num_epochs": 5,
    "stack_size": 1,
    "term_cond_avg_score": 350.0,
    "term_cond_max_episodes": 1000,
    "sac_alpha": 0.2,
}
METADATA = {
    "action_space": [{"steering_angle": angle, "speed": 0.6} for angle in (-30, -15, 0, 15, 30)],
    "sensor": ["FRONT_FACING_CAMERA"],
    "neural_network": "DEEP_CONVOLUTIONAL_NETWORK_SHALLOW",
    "training_algorithm": "clipped_ppo",
    "action_space_type": "discrete",
    "version": "5",
    "lidar_config": {"num_sectors": 8},
}
CONTINUOUS = METADATA | {
    "action_space": {"steering_angle": {"low": "-30", "high": 30.0}, "speed": {"low": 1, "high": "2"}},
    "action_space_type": "continuous",
}
REWARD = "WEIGHT = 2.0\n\n\ndef reward_function(params):\n    return WEIGHT * params['speed']\n"


def composed(folder: Path, *overrides: str) -> tuple[Experiment, tuple[str, ...]]:
    """Return the experiment of a folder's custom files, and what is said of them."""
    experiment, composition = compose_experiment([f"custom_files={folder}", *overrides])
    return experiment, composition.notes


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stand in an empty folder."""
    folder = tmp_path / "mein Ordner, (ü) = '$x'"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def own(here: Path) -> Callable[[str, str], Path]:
    """Write an option's file of one's own: `own("budget/mine.yaml", TEXT)`."""

    def write(name: str, text: str) -> Path:
        path = here / "conf" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    return write


@pytest.fixture
def custom_files(tmp_path: Path) -> Callable[..., Path]:
    """Write the files into a folder; a value of None leaves one out, a dict goes over the default's keys."""

    def write(
        hyperparameters: object = HYPERPARAMETERS,
        metadata: object = METADATA,
        reward: str | None = REWARD,
        folder: str = "my model",
    ) -> Path:
        path = tmp_path / folder
        path.mkdir(parents=True, exist_ok=True)
        for name, content in (
            ("hyperparameters.json", hyperparameters),
            ("model_metadata.json", metadata),
            ("reward_function.py", reward),
        ):
            if content is not None:
                (path / name).write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    return write
