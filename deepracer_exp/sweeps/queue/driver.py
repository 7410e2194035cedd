"""The driver of a sweep: starts workers, replaces those that die, and shows their progress."""

import collections
import contextlib
import re
import time
import uuid
from collections.abc import Callable, Sequence

from optuna.storages import RDBStorage

from deepracer_exp.errors import RunFailed
from deepracer_exp.training.signals import Interruption

from .claims import Claim, TrialClaims
from .launcher import LocalLauncher, LocalWorker
from .ray_launcher import RayLauncher, RayWorker
from .storage import patiently
from .worker_config import WorkerConfig, is_gone

_LOOK_S = 0.5
_LEAVE_S = 6.0
"""Time for an ending worker to write a checkpoint and to log to MLflow. The rest is done when its trial resumes; all in
all, the sweep ends within ten seconds."""
_FEW = 3
"""Failed trials, without any other, after which a sweep is given up."""


Show = Callable[[Sequence[Claim], str], None]
"""Draws all claims; the text describes the work while no trial runs, and may be empty."""


class Driver:
    """Runs the workers of a sweep."""

    def __init__(
        self,
        config: WorkerConfig,
        storage: RDBStorage,
        launcher: LocalLauncher | RayLauncher,
        show: Show,
        on_ended: Callable[[Sequence[Claim]], None],
    ):
        """Start nothing yet; `show` draws all claims, `on_ended` is called with them whenever trials have ended."""
        self._config, self._launcher, self._show, self._on_ended = config, launcher, show, on_ended
        self._claims = TrialClaims(storage.engine, config.study)
        self._running: list[LocalWorker | RayWorker] = []
        self._all_made = False
        """Whether a worker has found nothing left to do."""
        self._losses = 0
        """Workers that died since a trial last ended."""
        self._ended = -1
        self._ended_before: frozenset[int] = frozenset()
        """Numbers of the trials that ended before this start."""

    def run(self, interruption: Interruption) -> int | None:
        """Return when all trials are made: None, or the exit code when interrupted.

        Raises:
            RunFailed: all trials fail, workers keep dying, or the database does not answer.
        """
        self._config.folder.mkdir(parents=True, exist_ok=True)
        # Workers killed on this machine, mostly with their driver: their trials need not wait until a lease runs out.
        claims = self._look()
        self._ended_before = frozenset(claim.trial.number for claim in claims if claim.has_ended)
        for owner in {claim.owner for claim in claims if not claim.has_ended and is_gone(claim.owner)}:
            self._release(owner)
        try:
            return self._make_trials(interruption)
        except BaseException:
            self._kill()
            raise

    def _make_trials(self, interruption: Interruption) -> int | None:
        for _ in range(self._launcher.workers):
            self._start()
        while True:
            claims = self._look()
            self._show(claims, "")
            if interruption.signum is not None:
                stage = "ending: running trials write their checkpoints"
                self._show(claims, stage)
                self._end()
                self._show(self._look(), stage)
                return interruption.exit_code
            self._give_up_if_all_fail(claims)
            self._replace_lost_workers()
            if not self._running:
                return None
            time.sleep(_LOOK_S)

    def _start(self) -> None:
        self._running.append(self._launcher.start(self._config, uuid.uuid4().hex[:8]))

    def _replace_lost_workers(self) -> None:
        """Release the trials of workers that are gone, and start others instead."""
        for worker in [worker for worker in self._running if worker.exitcode is not None]:
            self._running.remove(worker)
            # A reward function can end its process with 0, too.
            if worker.exitcode == 0 and patiently(
                lambda: self._claims.is_done(self._config.config.trials), self._config.config.patience_s
            ):
                self._all_made = True
                continue
            if worker.owner is not None and worker.is_seen:
                self._release(worker.owner, is_lost=True)
            if worker.exitcode == RunFailed.exit_code:
                raise RunFailed(f"the study's database does not answer; {self._how_to_resume()}")
            if self._all_made:
                continue
            self._losses += 1
            if self._losses > 2 * self._launcher.workers + _FEW:
                logs = [str(log) for log in self._config.folder.glob("workers*.log") if log.stat().st_size]
                why = f"see {' and '.join(logs)}" if logs else "a reward function can do that"
                raise RunFailed(
                    f"workers keep dying, the last one with exit code {worker.exitcode}; {why}; "
                    f"{self._how_to_resume()}"
                )
            self._start()
        if self._all_made:
            # Workers that still wait for room on a cluster are not needed.
            for worker in [worker for worker in self._running if worker.owner is None]:
                self._running.remove(worker)
                worker.kill()

    def _release(self, owner: str, *, is_lost: bool = False, patience_s: float | None = None) -> None:
        patiently(
            lambda: self._claims.release(owner, is_lost=is_lost),
            patience_s or self._config.config.patience_s,
        )

    def _look(self) -> list[Claim]:
        claims = patiently(self._claims.all, self._config.config.patience_s)
        ended = sum(claim.has_ended for claim in claims)
        if ended != self._ended:
            self._ended, self._losses = ended, 0
            self._on_ended(claims)
        return claims

    def _give_up_if_all_fail(self, claims: Sequence[Claim]) -> None:
        ended = [claim.trial for claim in claims if claim.has_ended]
        if any(trial.state != "FAIL" for trial in ended):
            return
        # Failures of an earlier start do not count: their cause may be gone.
        failed = [trial for trial in ended if trial.number not in self._ended_before]
        if len(failed) < min(_FEW, self._config.config.trials - len(self._ended_before)):
            return
        # Equal errors differ in the file of their run.
        folder = re.escape(str(self._config.folder.resolve())) + r"/[^/\s:]+"
        reasons = collections.Counter(re.sub(folder, "RUN", trial.reason) for trial in failed)
        ((reason, count),) = reasons.most_common(1)
        self._end()
        raise RunFailed(f"all {len(failed)} trials so far failed, {count} of them with: {reason}")

    def _end(self) -> None:
        """Ask the workers to end, and wait for them."""
        for worker in self._running:
            worker.terminate()
        until = time.monotonic() + _LEAVE_S
        for worker in self._running:
            worker.join(max(until - time.monotonic(), 0.1))
        self._kill()

    def _kill(self) -> None:
        for worker in self._running:
            worker.kill()
            if worker.owner is None or not worker.is_seen:
                continue
            # If the database is away, the trial is free once its lease has run out.
            with contextlib.suppress(RunFailed):
                self._release(worker.owner, patience_s=1.0)
        self._running.clear()

    def _how_to_resume(self) -> str:
        return f"resume with `deepracer-exp sweep study={self._config.study}`"
