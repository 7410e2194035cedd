"""Runs: begun, gone on with after an early end, or begun from another run's checkpoint."""

import ast
import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from deepracer_exp.agents.actor_critic import ActorCritic
from deepracer_exp.config.compose import Composition, validate
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.overrides import group_of
from deepracer_exp.config.stored import with_overrides
from deepracer_exp.env.reward import RewardFunction
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.errors import BadInput, RunFailed, reading
from deepracer_exp.evaluation.checkpoint import intact_checkpoint
from deepracer_exp.formats.lineage_file import LINEAGE, Lineage, read_lineage
from deepracer_exp.formats.run_files import read_config, read_object
from deepracer_exp.sim.batch import CarBatch
from deepracer_exp.tracking import tracking_file
from deepracer_exp.tracking.names import joined, lineage_tags, run_params, run_tags
from deepracer_exp.tracking.recorder import Tracker, open_tracker

from .alerts import Alerts
from .budget import Budget, refuse_spent
from .checkpoints import read_training
from .header import track_names
from .origin import refuse_changes
from .outcome import Outcome
from .ray_cluster import check_collector
from .run_folder import RunFolder
from .signals import Interruption
from .stopping import UNDECIDED
from .training import SPENT, TIMES, Training
from .watching import TakenOver, Watch

__all__ = ["TIMES", "Outcome", "RunEnded", "read_files", "resume", "train"]

logger = logging.getLogger("deepracer_exp")


_AGAIN = ("interrupted", "failed")
"""How runs end that can go on."""


class RunEnded(BadInput):
    """A run that is to go on has come to its end."""


def train(
    experiment: Experiment,
    composition: Composition,
    console: Console,
    start: tuple[ActorCritic, Lineage] | None = None,
    watch: Watch | None = None,
) -> Outcome:
    """Train the experiment.

    Args:
        experiment: validated.
        composition: where it came from.
        console: for the view of the progress.
        start: networks to begin with, and whose they were; None: new ones.
        watch: looks on.

    Returns:
        How it ended; a failed run's line is its `reason`.

    Raises:
        BadInput: before anything was started; no folder is left.
        TakenOver: `watch` said so.
    """
    # From here on, so that Ctrl-C during the start leaves a whole folder, too.
    with Interruption(_printing(console)) as interruption:
        training = _begin(experiment, composition, console, start, watch)
        return _run(training, interruption)


def resume(run_dir: Path, overrides: Sequence[str], console: Console, watch: Watch | None = None) -> Outcome:
    """Go on with a run that ended before its time, from its last checkpoint.

    Args:
        run_dir: its folder.
        overrides: of values that change nothing of what it learns.
        console: for the view of the progress.
        watch: looks on.

    Raises:
        BadInput: the run has come to its end, or is being trained, or cannot go on as it was.
        TakenOver: `watch` said so.
    """
    with Interruption(_printing(console)) as interruption:
        return _run(_resumed(run_dir, overrides, console, watch), interruption)


def read_files(experiment: Experiment) -> RaceSetup:
    """Read the files an experiment names and run the reward function's module once.

    Raises:
        BadInput: a file is missing or malformed, or values contradict.
    """
    setup = build_setup(experiment)
    RewardFunction(setup.reward, 1, setup.reward_time_limit_s, None)
    with reading(f"car {experiment.car.name}", "dimensions, masses and settings of a car that can stand"):
        CarBatch(setup.car, 1, 1)
    check_collector(experiment.collector)
    return setup


def _begin(
    experiment: Experiment,
    composition: Composition,
    console: Console,
    start: tuple[ActorCritic, Lineage] | None,
    watch: Watch | None,
) -> Training:
    setup = read_files(experiment)
    refuse_spent(experiment.budget, Path(experiment.runs_dir) / experiment.name)
    Alerts(experiment.budget)  # refuses what can never be told
    tracker = open_tracker(experiment.tracking, Path(experiment.runs_dir))
    lineage = None if start is None else start[1]
    names = _names(composition, joined(track_names(setup)), setup.reward.name)
    label = f"{names['track']}-{names['reward']}-seed{experiment.seed}"
    if lineage is not None:
        label += f"-clone{lineage.generation}"
    folder = RunFolder.create(experiment.runs_dir, experiment.name, label)
    try:
        training = Training(experiment, setup, folder, composition.mapping, names, tracker, console, watch)
        if start is not None:
            training.networks.load_state_dict(start[0].state_dict())
            folder.write(LINEAGE, json.dumps(asdict(start[1]), indent=2) + "\n")
        if watch is not None:
            watch.begins(folder.path)
        training.save_start()
        commit = folder.describe(composition, setup.reward, experiment.seed, names)
    except (OSError, RunFailed) as error:
        folder.remove()
        what = (
            f"cannot write {error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
        )
        raise BadInput(f"runs_dir={experiment.runs_dir}: {what}; give a folder with room") from error
    except BaseException:
        folder.remove()
        raise
    for note in composition.notes:
        logger.info(note)
    _track(tracker, folder, experiment, composition, names, setup, commit, watch)
    return training


def _track(
    tracker: Tracker,
    folder: RunFolder,
    experiment: Experiment,
    composition: Composition,
    names: Mapping[str, str],
    setup: RaceSetup,
    commit: str | None,
    watch: Watch | None,
) -> None:
    """Begin to record a run that no tracker has heard of."""
    lineage = read_lineage(folder.path)
    tags = run_tags(names, commit, setup.reward.sha256, folder.path.resolve())
    if lineage is not None:
        tags |= lineage_tags(lineage)
    if watch is not None:
        tags |= watch.tags
    # MLflow's table shows some 20 characters; the folder's name is in the tag run_dir.
    what = names["reward"] if lineage is None else f"clone {lineage.generation}"
    title = f"{what} s{experiment.seed} {time.strftime('%H:%M:%S')}" if watch is None else watch.title
    tracker.start(
        title,
        experiment.name,
        run_params(composition.choices, names, composition.mapping, composition.overrides),
        tags,
        identity=folder.path / tracking_file.NAME,
    )


def _resumed(run_dir: Path, overrides: Sequence[str], console: Console, watch: Watch | None) -> Training:
    stored = read_config(run_dir)
    provenance = read_object(run_dir / "provenance.json")
    names = provenance.get("names", {})
    composition = with_overrides(stored, names, overrides)
    # The folder may have been moved with the one it lies in.
    composition.mapping["runs_dir"] = str(run_dir.parent.parent)
    experiment = validate(composition.mapping)
    _refuse_ended(run_dir, experiment, "stopping" in map(group_of, overrides))
    setup = read_files(experiment)
    checkpoint = intact_checkpoint(run_dir / "checkpoints", "last", resumable=True)
    state = read_training(checkpoint)
    refuse_changes(run_dir, state, composition.mapping, setup)
    tracker = open_tracker(experiment.tracking, Path(experiment.runs_dir))
    folder = RunFolder(run_dir)
    iteration = state["iteration"]
    try:
        training = Training(experiment, setup, folder, stored, names, tracker, console, watch)
        rows = training.rows_until(iteration)
        if len(rows) != iteration:
            raise BadInput(
                f"{run_dir / 'metrics.jsonl'}: has {len(rows)} of the {iteration} rows up to the checkpoint; restore "
                "the file, or train on from the checkpoint with `deepracer-exp clone`"
            )
        training.resume_from(checkpoint, state, rows)
        if (folder.path / tracking_file.NAME).exists():
            tracker.reopen(folder.path / tracking_file.NAME)
        else:  # killed before it was recorded, or trained with tracking=off
            commit = provenance.get("git_commit")
            _track(tracker, folder, experiment, composition, names, setup, commit, watch)
    except BadInput:
        folder.release()
        raise
    training.tell_again(rows)
    if read_object(run_dir / "summary.json").get("stopping"):
        for tag, value in UNDECIDED.items():
            tracker.set_tag(tag, value)
    folder.rewind(rows)
    training.checkpoints.rewind(iteration, (state["best"] or {}).get("iteration"))
    folder.write("config.yaml", composition.yaml())
    where = f"resumes after iteration {iteration}" if iteration else "had no checkpoint yet: begins again"
    logger.info(where)
    _printing(console)(f"{run_dir.name}: {where}")
    for why in _not_the_same(experiment, setup):
        logger.warning("the result will not be that of an uninterrupted run: %s", why)
    return training


def _printing(console: Console) -> Callable[[str], None]:
    """Return what prints a line as it is, above the view of the progress where that is shown."""
    return lambda line: console.print(line, markup=False, highlight=False, soft_wrap=True)


def _run(training: Training, interruption: Interruption) -> Outcome:
    try:
        reason = training.drive_and_learn(interruption)
        code = interruption.exit_code
        return training.close(training.verdict if code is None else "interrupted", reason, code or 0)
    except (RunFailed, BadInput) as error:  # BadInput: what it wrote itself is gone or was changed
        return training.fail(str(error), error)
    except OSError as error:
        return training.fail(f"{error.filename or training.folder.path}: {error.strerror or error}", error)
    except TakenOver:
        training.let_go()
        raise
    except KeyboardInterrupt:
        return training.break_off(interruption.exit_code or 130)
    except Exception as error:
        # A fault of ours: told with its traceback, but the run must not look as if it went on.
        training.fail(f"{type(error).__name__}: {error}", error)
        raise


def _refuse_ended(run_dir: Path, experiment: Experiment, rule_given: bool) -> None:
    """Refuse to go on with a run that is over.

    Args:
        run_dir: its folder.
        experiment: it is to go on with.
        rule_given: whether it is to have another stopping rule. What ended it, a rule of its own or a comparison with
            others, does not count then; a budget that is still spent does.
    """
    summary = read_object(run_dir / "summary.json")
    status, reason = summary.get("status"), str(summary.get("reason"))
    if status is None or status in _AGAIN:
        return
    if not reason.startswith(SPENT):
        if rule_given:
            return
        raise RunEnded(
            f"{run_dir}: has ended ({status}: {reason}); stopping=none lets it go on, `deepracer-exp clone "
            f"run={run_dir.name}` begins a new run with its best checkpoint"
        )
    used = Budget(experiment.budget).used(summary["env_steps"], summary["iteration"], summary["wall_clock_s"])
    if used[1] >= 1:
        raise RunEnded(f"{run_dir}: has ended ({reason}); to go on give it more, such as budget.{used[0]}=")


def _not_the_same(experiment: Experiment, setup: RaceSetup) -> list[str]:
    """Return why a resumed run cannot equal an uninterrupted one bit for bit."""
    why = []
    if experiment.collector.mode == "async":
        why.append("with collector=async the cars begin new episodes, and workers take turns as they come")
    clocks = ("minutes", "max_cost", "experiment_minutes", "experiment_max_cost", "experiment_env_steps")
    by_clock = [name for name in clocks if getattr(experiment.budget, name) is not None]
    if by_clock and experiment.lr_schedule.by == "fraction":
        why.append(f"the learning rate follows the clock (budget.{by_clock[0]}, lr_schedule.by=fraction)")
    if any(isinstance(node, ast.Global) for node in ast.walk(ast.parse(setup.reward.text))):
        why.append(
            f"the reward function {setup.reward.name} keeps something in a global variable, which is lost"
        )
    return why


def _names(composition: Composition, track: str, reward: str) -> dict[str, str]:
    """Return what a racer calls the run's choices: an option's name, a file's stem, the folder of custom_files."""
    choices, mapping = composition.choices, composition.mapping
    actions_file = mapping["action_space"].get("file")
    return {
        "track": track,
        "reward": reward,
        "action_space": Path(actions_file).stem if actions_file else choices["action_space"],
        "network": choices["network"],
        "lr_schedule": choices["lr_schedule"],
    } | dict(composition.names)
