"""The policy that a new one first learns to act like (`algorithm=distill teacher=RUN`)."""

from dataclasses import replace
from pathlib import Path

from tensordict.nn import TensorDictModuleBase

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.action_space import build_action_space, describe_actions
from deepracer_exp.errors import BadInput
from deepracer_exp.lookup.kept import kept_run
from deepracer_exp.lookup.resolve import StoredRun
from deepracer_exp.runs.files import TEACHER


def check_teacher(run: StoredRun, experiment: Experiment) -> StoredRun:
    """Return the run that an experiment's policy learns from, with the name of the checkpoint that was read.

    Raises:
        BadInput: the checkpoint is corrupt, its policy has other actions, or it sees what the cars of this experiment
            do not.
    """
    stored = run.read_policy()
    what = f"teacher={experiment.teacher}"
    theirs, ours = (
        describe_actions(build_action_space(side.action_space)) for side in (run.experiment, experiment)
    )
    if theirs != ours:
        raise BadInput(what, f"has other actions: {theirs}", f"a run with {ours}")
    before, now = run.experiment.observation, experiment.observation
    sees = stored.networks.policy.in_keys
    for key, sensor in (("pixels", "camera"), ("lidar", "lidar")):
        if key in sees and getattr(before, sensor) != getattr(now, sensor):
            raise BadInput(
                what, f"sees other {key}", f"a run with the same {sensor}, or observation=features"
            )
    features = [replace(observation, camera=None, lidar=None) for observation in (before, now)]
    if "observation" in sees and features[0] != features[1]:
        raise BadInput(what, "sees other features", "a run whose features are those of this observation")
    return StoredRun(run.path, stored.path.name)


def read_teacher(folder: Path) -> TensorDictModuleBase:
    """Return the teacher's policy that is kept in a run's folder.

    Raises:
        BadInput: it is missing or corrupt.
    """
    return kept_run(folder / TEACHER).read_policy().networks.policy
