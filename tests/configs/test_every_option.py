import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.agents.schedules import PresetSchedule
from deepracer_exp.config.compose import Composition, compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.options import conf_dir, groups, options
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.env.others.head_to_head import HeadToHead, rival_setup
from deepracer_exp.env.race import Race
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.training.budget import Budget

FILES = [(path.parent.name, path.stem) for group in groups() for path in (conf_dir() / group).glob("*.yaml")]
# Worlds differ in nothing but their names; two stand for those without a file.
EVERY_OPTION = [*sorted(FILES), ("track", "Oval_track"), ("track", "2022_reinvent_champ_cw")]
EXPERIMENTS = options("experiment")
DRIVEN = ("track", "race", "car", "action_space", "observation", "randomization", "episode", "reward")


@cache
def composed(group: str, name: str) -> tuple[Experiment, Composition]:
    """Compose an option into the default experiment, a network with what it reads."""
    # Only the deepest needs pictures as large as the service's, for which the others' weights take seconds to draw.
    reads = {"lidar": "lidar", "deep": "camera"}.get(name, "camera_small")
    reads = "features" if name.startswith("mlp") else reads
    sees = [f"observation={reads}"] if group == "network" else []
    sees += ["observation.next_objects=2"] if group == "race" else []
    return compose_experiment([*sees, f"{group}={name}"])


def test_the_groups_are_the_fields_of_an_experiment():
    fields = {field.name for field in dataclasses.fields(Experiment)}
    assert set(groups()) - {"experiment"} <= fields
    assert fields - set(groups()) == {
        "name",
        "seed",
        "device",
        "runs_dir",
        "debug",
        "report",
        "trace",
    }


def test_every_folder_of_options_belongs_to_an_entry_point():
    named = {group for entry in conf_dir().glob("*.yaml") for group in groups(entry.stem)}
    folders = {path.parent.relative_to(conf_dir()).as_posix() for path in conf_dir().rglob("*.yaml")}
    assert named == folders - {"."}


def keys(value: object) -> object:
    """Return the tree of keys below a value; a user's own mapping and numbers have none."""
    if isinstance(value, dict):
        return {key: keys(item) for key, item in value.items() if key != "constants"}
    if isinstance(value, list | tuple):
        return [keys(item) for item in value]
    return None


@pytest.mark.parametrize(("group", "name"), EVERY_OPTION)
def test_every_option_composes_into_an_experiment_of_the_same_keys(group, name):
    experiment, composition = composed(group, name)
    assert composition.choices[group] == name
    assert keys(dataclasses.asdict(experiment)) == keys(composition.mapping)


@pytest.mark.parametrize(("group", "name"), [(g, n) for g, n in sorted(FILES) if g != "experiment"])
def test_an_option_file_holds_the_keys_of_its_group_alone(group, name):
    path = conf_dir() / group / f"{name}.yaml"
    content = yaml.safe_load(path.read_text())
    fields = {field.name for field in dataclasses.fields(getattr(composed(group, name)[0], group))}
    assert set(content) - {"defaults"} <= fields
    if "defaults" not in content:
        assert set(content) == fields


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_is_named_after_its_file(name):
    assert composed("experiment", name)[0].name == name


def race_with_rivals(setup: RaceSetup) -> Race:
    """Put two cars on the road, and where the race is head to head a rival of each that drives straight ahead."""
    if setup.others is None or setup.others.rivals is None:
        return Race(setup, 2)
    race = HeadToHead(setup, 2, rival_setup(setup, setup.observation))
    race.drive_with([lambda seen: seen.set("action", torch.zeros(*seen.batch_size, 2))])
    return race


@pytest.mark.parametrize(("group", "name"), [(g, n) for g, n in EVERY_OPTION if g in (*DRIVEN, "experiment")])
def test_every_option_puts_cars_on_the_road(group, name):
    experiment, _ = composed(group, name)
    race = race_with_rivals(build_setup(experiment))
    race.reset()
    n_actions = race.setup.actions.n
    for _ in range(4):
        race.step(np.zeros((2, 2)) if n_actions is None else np.full(2, n_actions // 2))
    assert np.isfinite(race.observation).all()
    assert np.isfinite(race.reward).all()
    assert not race.terminated.any()


@pytest.mark.parametrize("name", options("network"))
def test_every_network_is_built(name):
    experiment = composed("network", name)[0]
    network, observed = experiment.network, observation_shape(experiment.observation)
    assert build_actor_critic(network, observed, 5, torch.Generator().manual_seed(0)).policy


@pytest.mark.parametrize("name", options("lr_schedule"))
def test_every_schedule_gives_a_rate(name):
    schedule = PresetSchedule(composed("lr_schedule", name)[0].lr_schedule)
    assert 0 <= schedule.factor(0, 0.0) <= 1


@pytest.mark.parametrize("name", options("budget"))
def test_every_budget_ends_a_run(name):
    budget = Budget(composed("budget", name)[0].budget)
    assert budget.used(0, 0, 0.0)[1] == 0
    assert budget.used(10**12, 10**9, 1e12)[1] >= 1


def test_every_reward_of_the_zoo_has_an_option_of_its_name():
    zoo = {path.stem for path in (Path(conf_dir()).parent / "reward_zoo").glob("[!_]*.py")}
    assert set(options("reward")) == zoo
    for name in zoo:
        assert composed("reward", name)[0].reward.name == name
