"""The best policy of a run, driven again for its page: its fastest evaluated lap, and its views along a lap."""

from dataclasses import dataclass, replace
from pathlib import Path

from deepracer_exp.aws.logs.recorded import LogProblem
from deepracer_exp.config.own_class import OF_POLICY, named_again
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.film import Lap, LapRecorder, best_attempt, drive_best_lap
from deepracer_exp.reports.charts.driving_line import EvaluatedLap
from deepracer_exp.reports.tables.log_view import LogView
from deepracer_exp.runs.checkpoint_files import checkpoint_words, kept_checkpoints
from deepracer_exp.runs.run_files import CHECKPOINTS, read_config
from deepracer_exp.runs.stored_run import StoredRun

from .page import Glimpse
from .sight import glimpses


@dataclass(frozen=True, eq=False)
class BestDrive:
    """The laps and views of a run's best policy."""

    lap: EvaluatedLap | None = None
    strip: tuple[Glimpse, ...] = ()
    """Pictures along a lap; empty for a policy without a camera."""


def drive_best(view: LogView, folder: Path, just_trained: bool = False) -> tuple[LogView, BestDrive]:
    """Return a recorded training's view, and its best policy's driving under the usual conditions.

    A training stores no steps of its evaluations, but the same policy drives the same laps again. One that sees
    pictures drives a single lap: they take long.

    Args:
        view: the training.
        folder: of the run.
        just_trained: the training in this process has imported the user's own classes; else a run that needs them is
            left out, since a recording may come from anywhere.

    Returns:
        The view, with another problem if the policy could not be used; and the drive.
    """
    try:
        if not kept_checkpoints(folder / CHECKPOINTS):
            return view, BestDrive()
        if not just_trained and named_again(read_config(folder), OF_POLICY):
            return view, BestDrive()
        run = StoredRun(folder).with_checkpoint()
        stored, experiment = run.read_policy(), run.experiment
        policy, camera = stored.networks.policy, experiment.observation.camera
        protocol = replace(experiment.evaluation, held_out=None)
        if camera is not None:
            evaluator = Evaluator(experiment, replace(protocol, trials=1, laps=1))
            lap, acted = drive_best_lap(evaluator, policy)
            strip = glimpses(lap, acted, policy, evaluator.race.setup.actions, camera)
            return view, BestDrive(_shown(lap, stored.path.name), tuple(strip))
        evaluator = Evaluator(experiment, protocol)
        recorder = LapRecorder(evaluator)
        evaluation = evaluator(policy, recorder)
        names = [course.name for course in evaluator.race.setup.courses]
        here = {
            number for number, trial in enumerate(evaluator.trials) if names[trial.course] == view.track_name
        }
        return view, BestDrive(_shown(recorder.lap(best_attempt(evaluation, here or None)), stored.path.name))
    except (BadInput, RunFailed) as error:
        return replace(view, problems=(*view.problems, LogProblem(view.name, None, str(error)))), BestDrive()


def _shown(lap: Lap, checkpoint: str) -> EvaluatedLap:
    """Return a lap of a checkpoint for its picture; in the prepare step the car stands."""
    attempt = lap.attempt
    words = (
        f"The fastest evaluated lap: {attempt.time_s:.2f} s"
        if attempt.complete
        else f"Evaluated, it comes {attempt.progress:.0f}% of the way"
    )
    return EvaluatedLap(
        words=words,
        whose=checkpoint_words(checkpoint),
        course=lap.track,
        x_m=lap.x_m[1:],
        y_m=lap.y_m[1:],
        speed_mps=lap.speed_mps[1:],
        boxes=lap.boxes,
    )
