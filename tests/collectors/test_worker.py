import pytest
import torch
from torchrl.collectors import Collector

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.collectors.car_worker import CarCollector, EnvFactory, SamplingPolicy
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.env.setup import build_setup

CARS, STEPS = 4, 14


@pytest.fixture
def collector_of(tmp_path):
    made = []

    def make(*overrides: str) -> CarCollector:
        experiment, _ = compose_experiment(["experiment=tiny", *overrides])
        setup = build_setup(experiment)
        env = EnvFactory(setup=setup, worker=0, n_cars=CARS, threads=1, run_dir=tmp_path)()
        shapes = observation_shape(experiment.observation), setup.actions.n
        policy = build_actor_critic(experiment.network, *shapes, torch.Generator().manual_seed(1)).policy
        options = {"use_buffers": True, "trust_policy": True, "track_traj_ids": False}
        made.append(
            CarCollector(
                env,
                SamplingPolicy(policy),
                frames_per_batch=CARS * STEPS,
                total_frames=-1,
                auto_register_policy_transforms=False,
                **options,
            )
        )
        return made[-1]

    yield make
    for collector in made:
        collector.shutdown()


@pytest.mark.parametrize(
    "overrides",
    [
        ("action_space=continuous", "network=mlp_small"),
        ("action_space=discrete", "network=mlp_small_shared"),
        ("observation=camera_small", "network=cnn_small"),
    ],
    ids=["compiled", "shared", "pictures"],
)
def test_a_batch_is_the_one_of_the_librarys_rollout(collector_of, overrides):
    """Three batches, in which episodes end by the limit and begin again."""
    ours, library = (collector_of("episode.max_steps=12", *overrides) for _ in range(2))
    for _ in range(3):
        batch, expected = ours.rollout(), Collector.rollout(library)
        assert batch.batch_size == expected.batch_size == (CARS, STEPS)
        assert set(batch.keys(True, True)) == set(expected.keys(True, True))
        for key in batch.keys(True, True):
            assert batch[key].dtype == expected[key].dtype, key
            torch.testing.assert_close(
                batch[key], expected[key], rtol=0, atol=0, equal_nan=True, msg=str(key)
            )
    assert batch["next", "done"].any()
