"""The files that an experiment names, read without running any of them and before anything heavy is imported."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.rewards.source import RewardSource, load_reward_source

from .action_space import ActionSpace, action_remarks, build_action_space

if TYPE_CHECKING:
    from deepracer_exp.tracks.track import Track


@dataclass(frozen=True)
class RaceFiles:
    """Contents of the files that an experiment names."""

    reward: RewardSource
    actions: ActionSpace
    tracks: "Mapping[str, tuple[Track, ...]]"
    """The tracks that have a file, by name, in each direction in which they are driven."""
    remarks: tuple[str, ...]
    """Warnings about an action space that a racer may not have meant, a line each."""


def read_race_files(experiment: Experiment) -> RaceFiles:
    """Read the files that an experiment names.

    Raises:
        BadInput: one is missing or malformed.
    """
    reward = load_reward_source(experiment.reward)
    actions = build_action_space(experiment.action_space)
    tracks = {}
    with_file = {name: track for name, track in experiment.tracks.items() if track.file is not None}
    if with_file:
        from deepracer_exp.tracks.track import directed_tracks  # imports numba and shapely

        tracks = {name: directed_tracks(track) for name, track in with_file.items()}
    return RaceFiles(reward, actions, tracks, tuple(action_remarks(actions, experiment.car)))
