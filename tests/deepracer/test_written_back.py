"""What is written reads as what it was."""

from dataclasses import replace
from pathlib import Path

import pytest

from deepracer_exp.deepracer.hyperparameters import (
    KEYS,
    Hyperparameters,
    hyperparameters_text,
    read_hyperparameters,
)
from deepracer_exp.deepracer.model_metadata import (
    Action,
    LidarConfig,
    ModelMetadata,
    model_metadata_text,
    read_model_metadata,
)

DISCRETE = ModelMetadata(
    action_space_type="discrete",
    actions=(Action(-30.0, 0.6), Action(0.0, 2.25), Action(17.5, 4.0)),
    low=None,
    high=None,
    sensor=("STEREO_CAMERAS", "SECTOR_LIDAR"),
    neural_network="DEEP_CONVOLUTIONAL_NETWORK",
    version=4,
    training_algorithm="clipped_ppo",
    lidar_config=LidarConfig(num_sectors=16, num_values_per_sector=4, clipping_dist_m=3.5),
    given=(),
    renumbered=False,
)
CONTINUOUS = replace(
    DISCRETE,
    action_space_type="continuous",
    actions=(),
    low=Action(-25.0, 0.5),
    high=Action(30.0, 3.0),
    sensor=("FRONT_FACING_CAMERA",),
    lidar_config=LidarConfig(),
    training_algorithm="sac",
    version=5,
)


@pytest.mark.parametrize("metadata", [DISCRETE, CONTINUOUS], ids=["discrete", "continuous"])
def test_a_written_model_metadata_reads_as_it_was(tmp_path: Path, metadata: ModelMetadata):
    path = tmp_path / "model_metadata.json"
    path.write_text(model_metadata_text(metadata))
    assert read_model_metadata(path) == metadata
    assert not read_model_metadata(path).renumbered


def test_written_hyperparameters_read_as_they_were(tmp_path: Path):
    values = Hyperparameters(
        batch_size=128, lr=1e-5, loss_type="huber", term_cond_max_episodes=7, e_greedy_value=0.5
    )
    path = tmp_path / "hyperparameters.json"
    path.write_text(hyperparameters_text(values))
    read = read_hyperparameters(path)
    assert replace(read, given=()) == values
    assert sorted(read.given) == sorted(KEYS)
