"""What the commands do can be done from Python, without private names."""

import inspect

import pytest
import torch
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type

import deepracer_exp
from deepracer_exp import (
    BadInput,
    Callback,
    compose,
    evaluate,
    load_policy,
    make_env,
    read_run,
    resume,
    train,
)
from tests.conftest import IN_PROCESS


class StopsAfterTwo(Callback):
    """Adds a column to the metrics, and ends the run."""

    def on_iteration_end(self, trainer):
        trainer.row["twice"] = 2 * trainer.iteration
        if trainer.iteration == 2:
            trainer.request_stop("two are enough")


def test_an_experiment_is_trained_with_an_own_callback_raced_and_read(tmp_path):
    experiment = compose(*IN_PROCESS, f"runs_dir={tmp_path}", "algorithm.lr=1e-3")
    assert experiment.config.algorithm.lr == 1e-3
    result = train(experiment, callbacks=[StopsAfterTwo()])
    assert (result.status, result.reason, result.exit_code) == ("finished", "two are enough", 0)

    run = read_run(result.folder)
    assert run.metrics["twice"].tolist() == [2, 4]
    assert run.summary["iteration"] == 2
    assert len(run.steps) == run.metrics["env_steps"].iloc[-1]
    assert run.config["algorithm"]["lr"] == 1e-3

    evaluation = evaluate(result.folder, "checkpoint=last", "evaluation.trials=1", "evaluation.held_out=null")
    assert 0 <= evaluation.groups[0].completion <= 100
    assert list(result.folder.glob("evaluations/*.json"))


def test_a_run_is_resumed_with_the_callbacks_it_was_trained_with(tmp_path):
    run = train(
        compose(*IN_PROCESS, f"runs_dir={tmp_path}", "budget.env_steps=1024"), callbacks=[StopsAfterTwo()]
    )
    assert read_run(run.folder).metrics["twice"].tolist() == [2]
    with pytest.raises(BadInput, match="has ended"):
        resume(run.folder.name, runs_dir=tmp_path)
    result = resume(run.folder, "budget.env_steps=4096", callbacks=[StopsAfterTwo()])
    assert (result.folder, result.reason) == (run.folder, "two are enough")
    assert read_run(result.folder).metrics["twice"].tolist() == [2, 4]


def test_a_stored_policy_drives_the_environment(trained):
    run = trained()
    env = make_env(compose(*IN_PROCESS), n_cars=3)
    check_env_specs(env)
    policy = load_policy(run.folder, "last")
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        first, second = (env.rollout(5, policy, auto_reset=True)["action"] for _ in range(2))
    assert first.shape == (3, 5, 2)
    assert first.dtype == second.dtype == torch.float32


def test_what_a_public_function_returns_is_public():
    for call in (compose, evaluate, make_env, read_run, resume, train):
        returned = inspect.signature(call, eval_str=True).return_annotation
        assert getattr(deepracer_exp, returned.__name__) is returned


def test_dir_lists_the_whole_api():
    assert set(deepracer_exp.__all__) <= set(dir(deepracer_exp))
    assert all(getattr(deepracer_exp, name) is not None for name in deepracer_exp.__all__)
