"""Gives up a trial whose policy has collapsed or learns nothing."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optuna.study import Study
from optuna.trial import FrozenTrial
from pydantic import TypeAdapter

from deepracer_exp.config.stopping import EntropyStopping, StoppingConfig
from deepracer_exp.formats.run_files import RunRecord, read_config, read_metrics
from deepracer_exp.training.stopping import Decision, Row, Stopping
from deepracer_exp.training.stopping_replay import action_count

from .verdict import ExplainedPruner, Verdict

_STOPPING: TypeAdapter[StoppingConfig] = TypeAdapter(StoppingConfig)
_FOLLOWED = 32  # runs at a time; one that was forgotten is read from its first row again


class EntropyPruner(ExplainedPruner):
    """The hopeless ends of the stopping rule `entropy`, looked for in the files of a trial's run.

    A run with a rule `entropy` of its own is judged by its own thresholds. The first decision on a run stays: what
    has converged is never given up, however it goes on.
    """

    def __init__(self, rules: EntropyStopping):
        """Set it up.

        Args:
            rules: for runs whose own stopping is another.
        """
        self._rules = rules
        self._followed: dict[str, _Followed] = {}

    def verdict(self, study: Study, trial: FrozenTrial) -> Verdict | None:
        """Return `collapsed` or `not_learning` and the reason, None to go on.

        A trial without a run, and a run without an iteration, go on.

        Raises:
            BadInput: the run's files hold something else than what a training writes.
        """
        run_dir = trial.user_attrs.get("run_dir")
        decision = None if run_dir is None else self._decision(run_dir)
        if decision is None or not decision.hopeless:
            return None
        return Verdict(decision.rule, decision.why)

    def _decision(self, run_dir: str) -> Decision | None:
        path = Path(run_dir)
        metrics = path / "metrics.jsonl"
        if not metrics.exists():
            return None
        rows = read_metrics(metrics)
        followed = self._followed.pop(run_dir, None)
        if followed is None or not followed.goes_on_in(rows):
            followed = _Followed(self._stopping(path))
        followed.observe(rows)
        self._followed[run_dir] = followed
        if len(self._followed) > _FOLLOWED:
            del self._followed[next(iter(self._followed))]
        return followed.decision

    def _stopping(self, path: Path) -> Stopping:
        config = read_config(path)
        own: Any = _STOPPING.validate_python(config["stopping"])
        rules = own if isinstance(own, EntropyStopping) else self._rules
        return Stopping(rules, action_count(RunRecord(path, config, [], {}, {})))


@dataclass
class _Followed:
    """What was seen of a run."""

    stopping: Stopping
    rows: int = 0
    last: Row | None = None
    decision: Decision | None = None

    def goes_on_in(self, rows: list[dict[str, Any]]) -> bool:
        """Return whether these rows begin with those seen; a run that was resumed has gone back before it goes on."""
        return self.rows == 0 or (len(rows) >= self.rows and rows[self.rows - 1] == self.last)

    def observe(self, rows: list[dict[str, Any]]) -> None:
        for row in rows[self.rows :]:
            self.rows, self.last = self.rows + 1, row
            if self.decision is None:
                self.decision = self.stopping.observe(row)
