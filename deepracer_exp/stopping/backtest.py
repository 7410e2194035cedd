"""Backtests of stopping rules: the iteration at which a rule would have ended runs that continued."""

from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import TypeAdapter, ValidationError
from rich.table import Table

from deepracer_exp.config.driving import ActionSpaceConfig
from deepracer_exp.config.stopping import ReliableStopping, StoppingConfig
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.files import CONFIG, METRICS, RunRecord, full_name
from deepracer_exp.runs.fingerprint import REMEMBERED_EPISODES
from deepracer_exp.runs.result import with_unit

from .rules import Decision, Row, StoppingRule, build_rule

_NOTHING = "\N{EN DASH}"


@dataclass(frozen=True, kw_only=True)
class Backtest:
    """A run and where a stopping rule would have ended it."""

    run: str
    rule: str
    """The rule that was applied, as its overrides."""
    decision: Decision | None
    """The decision that would have ended the run; None if there was none."""
    iteration: int
    """The iteration after which the run would have ended; its last one without a decision."""
    iterations: int
    """Number of iterations of the whole run."""
    env_steps: int
    saved_steps: int
    saved_s: float
    completion: float | None
    """Mean per cent of the lap over the last ten iterations before the end."""
    completion_whole: float | None
    lap_time_s: float | None
    """Fastest lap up to the end: of the evaluated policies where the run has them, otherwise the fastest exploring lap.
    With several tracks the mean of theirs, None while one has none."""
    lap_time_whole_s: float | None
    evaluated: bool
    """Whether the laps are those of evaluated policies."""

    @property
    def saved(self) -> float:
        """Share of the run's steps that would have been saved."""
        return self.saved_steps / (self.env_steps + self.saved_steps)

    @property
    def lap_loss(self) -> float | None:
        """How much slower the fastest lap would have been, as a share of the whole run's."""
        if self.lap_time_s is None or self.lap_time_whole_s is None:
            return None
        return self.lap_time_s / self.lap_time_whole_s - 1


def backtest(record: RunRecord, config: StoppingConfig, rule: str) -> Backtest:
    """Apply a stopping rule to the metrics of a run.

    Raises:
        BadInput: the run has no iteration, or its files lack what the rule looks at.
    """
    rows = record.rows
    if not rows:
        raise BadInput(record.path / METRICS, "has no iteration; nothing to apply a rule to")
    if isinstance(config, ReliableStopping):
        _check_episodes(record, config)
    stopping = build_rule(config, action_count(record))
    decision, count = None, len(rows)
    for number, row in enumerate(rows, 1):
        decision = _observed(stopping, row, record, number)
        if decision is not None:
            count = number
            break
    last, end = rows[-1], rows[count - 1]
    return Backtest(
        run=full_name(record.path),
        rule=rule,
        decision=decision,
        iteration=end["iteration"],
        iterations=last["iteration"],
        env_steps=end["env_steps"],
        saved_steps=last["env_steps"] - end["env_steps"],
        saved_s=last["wall_clock_s"] - end["wall_clock_s"],
        completion=_ended_with(rows[:count]),
        completion_whole=_ended_with(rows),
        lap_time_s=_fastest(rows[:count], rows),
        lap_time_whole_s=_fastest(rows, rows),
        evaluated=_is_evaluated(rows),
    )


def table(backtests: Sequence[Backtest]) -> Table:
    """Return the backtests as a table, a line a run and rule, and for several runs the means of each rule."""
    grid = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("run", "rule"):
        grid.add_column(name, overflow="fold")
    for name in ("ends after", "steps", "saved", "completion", "fastest lap", "lap lost"):
        grid.add_column(name, justify="right", no_wrap=True)
    for tested in backtests:
        grid.add_row(
            tested.run,
            f"{tested.rule}\n{tested.decision or 'continues to the end'}",
            f"{tested.iteration} of {tested.iterations}",
            f"{tested.env_steps:,}",
            f"{tested.saved:.0%}, {tested.saved_s:.0f} s" if tested.decision else _NOTHING,
            _of(tested.completion, tested.completion_whole, "{:.1f}", "%"),
            _of(tested.lap_time_s, tested.lap_time_whole_s, "{:.2f}", "s")
            + " exploring" * (not tested.evaluated),
            _NOTHING if tested.lap_loss is None else f"{tested.lap_loss:.1%}",
        )
    for rule in dict.fromkeys(tested.rule for tested in backtests):
        of_rule = [tested for tested in backtests if tested.rule == rule]
        losses = [tested.lap_loss for tested in of_rule if tested.lap_loss is not None]
        if len(of_rule) > 1:
            saved = f"{sum(tested.saved for tested in of_rule) / len(of_rule):.0%}"
            lost = f"{sum(losses) / len(losses):.1%}" if losses else _NOTHING
            grid.add_row("mean", rule, "", "", saved, "", "", lost)
    return grid


def _of(value: float | None, whole: float | None, number: str, unit: str) -> str:
    if whole is None:
        return _NOTHING
    return f"{_NOTHING if value is None else number.format(value)} of {with_unit(number.format(whole), unit)}"


def _observed(stopping: StoppingRule, row: Row, record: RunRecord, number: int) -> Decision | None:
    try:
        return stopping.observe(row)
    except KeyError as error:
        raise BadInput(
            f"{record.path / METRICS} line {number}: has no {error.args[0]}; this is not a row that a training writes"
        ) from error


def _check_episodes(record: RunRecord, config: ReliableStopping) -> None:
    """Refuse another number of episodes than the run's lap_share was taken over."""
    remembered = record.config.get("stopping", {}).get("episodes", REMEMBERED_EPISODES)
    if remembered != config.episodes:
        raise BadInput(
            f"stopping.episodes={config.episodes}: {full_name(record.path)} recorded the share of its last "
            f"{remembered} episodes; accepted: {remembered}"
        )


def action_count(record: RunRecord) -> int | None:
    """Return how many actions a run's policy chooses between, None for a continuous one.

    Raises:
        BadInput: its configuration has no valid action space.
    """
    try:
        adapter: TypeAdapter[ActionSpaceConfig] = TypeAdapter(ActionSpaceConfig)
        space = adapter.validate_python(record.config.get("action_space"))
    except ValidationError as error:
        raise BadInput(record.path / CONFIG, f"action_space: {error.errors()[0]['msg'].lower()}") from error
    return build_action_space(space).n


def _ended_with(rows: Sequence[Row]) -> float | None:
    """Return the mean completion of the last ten iterations, because single ones vary."""
    completions = [row["completion"] for row in rows[-10:] if row["completion"] is not None]
    return sum(completions) / len(completions) if completions else None


def _is_evaluated(rows: Sequence[Row]) -> bool:
    return any(row.get("eval_lap_time_s") is not None for row in rows)


def _fastest(rows: Sequence[Row], every: Sequence[Row]) -> float | None:
    """Return the fastest lap in `rows`; `every` row of the run decides which columns have lap times."""
    if _is_evaluated(every):
        columns = ["eval_lap_time_s"]
    else:
        columns = [key for key in every[-1] if key.startswith("best_lap_time_s/")] or ["best_lap_time_s"]
    times_s = [[row[key] for row in rows if row.get(key) is not None] for key in columns]
    return sum(map(min, times_s)) / len(times_s) if all(times_s) else None
