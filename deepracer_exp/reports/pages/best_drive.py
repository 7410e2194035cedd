"""The best policy of a run, driven again for its page: its fastest evaluated lap, and its views along a lap."""

from dataclasses import dataclass, replace
from pathlib import Path

from deepracer_exp.aws.logs.recorded import LogProblem
from deepracer_exp.config.own_class import OF_POLICY, named_again
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.evaluation.evaluator import evaluator_against
from deepracer_exp.evaluation.film import Lap, LapRecorder, best_attempt, drive_best_lap
from deepracer_exp.evaluation.rival_run import kept_rival
from deepracer_exp.reports.charts.driving_line import evaluated_lap
from deepracer_exp.reports.charts.figure import Chart
from deepracer_exp.reports.tables.log_view import LogView
from deepracer_exp.runs.checkpoint_files import checkpoint_words, kept_checkpoints
from deepracer_exp.runs.run_files import CHECKPOINTS, read_config
from deepracer_exp.runs.stored_run import StoredRun

from .page import Glimpse
from .sight import glimpses


@dataclass(frozen=True, eq=False)
class BestDrive:
    """The laps and views of a run's best policy."""

    lap: Chart | None = None
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
            protocol = replace(protocol, trials=1, laps=1)
        evaluator = evaluator_against(kept_rival(experiment, folder), experiment, protocol)
        courses = evaluator.race.setup.courses
        here = {
            number
            for number, trial in enumerate(evaluator.trials)
            if courses[trial.course].name == view.track_name
        }
        if camera is not None:
            lap, acted = drive_best_lap(evaluator, policy, here or None)
            strip = glimpses(lap, acted, policy, evaluator.race.setup.actions, camera)
            shown = _shown(lap, stored.path.name, "An evaluated lap") if here else None
            return view, BestDrive(shown, tuple(strip))
        if not here:  # evaluated on other tracks
            return view, BestDrive()
        recorder = LapRecorder(evaluator)
        best = best_attempt(evaluator(policy, recorder), here)
        return view, BestDrive(_shown(recorder.lap(best), stored.path.name, "The fastest evaluated lap"))
    except (BadInput, RunFailed) as error:
        return replace(view, problems=(*view.problems, LogProblem(view.name, None, str(error)))), BestDrive()


def _shown(lap: Lap, checkpoint: str, what: str) -> Chart:
    """Draw a lap of a checkpoint; in the prepare step the car stands.

    `what` names a complete lap.
    """
    attempt = lap.attempt
    words = (
        f"{what}: {attempt.time_s:.2f} s"
        if attempt.complete
        else f"Evaluated, it comes {attempt.progress:.0f}% of the way"
    )
    return evaluated_lap(
        words=words,
        whose=checkpoint_words(checkpoint),
        course=lap.track,
        x_m=lap.x_m[1:],
        y_m=lap.y_m[1:],
        speed_mps=lap.speed_mps[1:],
        boxes=lap.boxes,
    )
