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
from deepracer_exp.config.driving import RewardConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.options import conf_dir, groups, options
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.env.others.head_to_head import HeadToHead, rival_setup
from deepracer_exp.env.race import Race
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.training.budget import Budget

FILES = sorted(
    (path.parent.name, path.stem) for group in groups() for path in (conf_dir() / group).glob("*.yaml")
)
# Worlds differ in nothing but their names; two stand for those without a file.
WORLDS = [("track", "Oval_track"), ("track", "2022_reinvent_champ_cw")]
ALONE = ("algorithm", "experiment", "observation", "stopping")
"""Groups whose options choose or exclude others: each is composed into the defaults."""
DRIVEN = ("track", "race", "car", "action_space", "observation", "randomization", "episode", "reward")


def reads(network: str) -> str:
    """Return an observation that a network reads."""
    # Only the deepest needs pictures as large as the service's, for which the others' weights take seconds to draw.
    observation = {"lidar": "lidar", "deep": "camera"}.get(network, "camera_small")
    return "features" if network.startswith("mlp") else observation


def rows() -> list[dict[str, str]]:
    """Return choices that have every option of every group at least once: many at a time, as composing takes long."""
    names: dict[str, list[str]] = {}
    for group, name in (*FILES, *WORLDS):
        names.setdefault(group, []).append(name)
    alone = [{group: name} for group in ALONE for name in names.pop(group)]
    together = [
        {group: options[row % len(options)] for group, options in names.items()}
        for row in range(max(map(len, names.values())))
    ]
    return [*alone, *together]


ROWS = rows()


def named(row: dict[str, str]) -> str:
    """Return a name of a row in the list of tests."""
    return "-".join(*row.items()) if len(row) == 1 else f"together {ROWS.index(row)}"


def composed_row(row: dict[str, str]) -> tuple[Experiment, Composition]:
    """Compose a row into the default experiment."""
    return composed(tuple(f"{group}={name}" for group, name in row.items()))


@cache
def composed(lines: tuple[str, ...]) -> tuple[Experiment, Composition]:
    network = dict(line.split("=") for line in lines).get("network")
    sees = ["observation.next_objects=2"] if any(line.startswith("race=") for line in lines) else []
    return compose_experiment([*([f"observation={reads(network)}"] if network else []), *sees, *lines])


def with_option(group: str, name: str) -> Experiment:
    """Return an experiment that has this option."""
    return composed_row(next(row for row in ROWS if row.get(group) == name))[0]


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


@pytest.mark.parametrize("row", ROWS, ids=named)
def test_every_option_composes_into_an_experiment_of_the_same_keys(row):
    experiment, composition = composed_row(row)
    assert row.items() <= composition.choices.items()
    assert keys(dataclasses.asdict(experiment)) == keys(composition.mapping)


def test_an_option_file_holds_the_keys_of_its_group_alone():
    for group, name in FILES:
        if group == "experiment":
            continue
        content = yaml.safe_load((conf_dir() / group / f"{name}.yaml").read_text())
        fields = {field.name for field in dataclasses.fields(getattr(with_option(group, name), group))}
        assert set(content) - {"defaults"} <= fields, (group, name)
        if "defaults" not in content:
            assert set(content) == fields, (group, name)


def test_every_experiment_is_named_after_its_file():
    for name in options("experiment"):
        assert with_option("experiment", name).name == name


def race_with_rivals(setup: RaceSetup) -> Race:
    """Put two cars on the road, and where the race is head to head a rival of each that drives straight ahead."""
    if setup.others is None or setup.others.rivals is None:
        return Race(setup, 2)
    race = HeadToHead(setup, 2, rival_setup(setup, setup.observation))
    ahead = torch.zeros(2) if setup.actions.n is None else torch.tensor(setup.actions.n // 2)
    race.drive_with([lambda seen: seen.set("action", ahead.expand(*seen.batch_size, *ahead.shape))])
    return race


@pytest.mark.parametrize("row", [row for row in ROWS if row.keys() & {*DRIVEN, "experiment"}], ids=named)
def test_every_option_puts_cars_on_the_road(row):
    race = race_with_rivals(build_setup(composed_row(row)[0]))
    race.reset()
    n_actions = race.setup.actions.n
    for _ in range(4):
        race.step(np.zeros((2, 2)) if n_actions is None else np.full(2, n_actions // 2))
    assert np.isfinite(race.observation).all()
    assert np.isfinite(race.reward).all()
    assert not race.terminated.any()


@pytest.mark.parametrize("name", options("network"))
def test_every_network_is_built(name):
    experiment = with_option("network", name)
    network, observed = experiment.network, observation_shape(experiment.observation)
    assert build_actor_critic(network, observed, 5, torch.Generator().manual_seed(0)).policy


def test_every_schedule_gives_a_rate():
    for name in options("lr_schedule"):
        schedule = PresetSchedule(with_option("lr_schedule", name).lr_schedule)
        assert 0 <= schedule.factor(0, 0.0) <= 1, name


def test_every_budget_ends_a_run():
    for name in options("budget"):
        budget = Budget(with_option("budget", name).budget)
        assert budget.used(0, 0, 0.0)[1] == 0, name
        assert budget.used(10**12, 10**9, 1e12)[1] >= 1, name


def test_every_reward_of_the_zoo_has_an_option_of_its_name():
    zoo = {path.stem for path in (Path(conf_dir()).parent / "reward_zoo").glob("[!_]*.py")}
    assert set(options("reward")) == zoo
    for name in zoo:
        plain = RewardConfig(name=name, file=None, constants={}, time_limit_s=5.0)
        assert with_option("reward", name).reward == plain
