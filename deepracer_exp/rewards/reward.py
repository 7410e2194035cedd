"""Calls reward functions for many cars, with a time limit and checks."""

import itertools
import math
import reprlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import CodeType
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.errors import BadInput, RunFailed

from .params import TrackParams, batch_params, row_keys, rows, scalar_params, select
from .prints import RewardPrints
from .source import RewardSource, source_with_constants
from .time_limit import TimeLimit, TimeLimitPassed, run_module, what_was_raised

Value = TypeVar("Value")

MAX_REWARD = 1e5
"""Larger absolute rewards end the job on the service (deepracer-simapp rollout_agent_ctrl.py)."""


class RewardFailed(RunFailed):
    """A reward function raised, timed out or returned something that is not a reward."""

    def __init__(
        self,
        message: str,
        params: dict[str, Any] | None = None,
        car: int | None = None,
        what: str = "",
    ) -> None:
        super().__init__(message)
        self.what = what
        """The function's mistake and its line, as part of the message."""
        self.params = params
        """The params of the call (`reward_batch`: of all cars, if the car is not known)."""
        self.car = car
        """Index of the car in its batch; None: not known."""


class RewardFunction:
    """One reward module, run for `n_cars` cars.

    Each car has its own module namespace, as on the service, where a process has one car: global variables persist
    from call to call and are not shared between cars. They are not part of a checkpoint. A module with
    `reward_batch(params)` is instead loaded once, and called once a step for all cars of a course.

    Args:
        source: The module and the values that replace its constants.
        n_cars: Number of cars.
        time_limit_s: Seconds of CPU for all calls of one step (see `TimeLimit` for where it holds).
        prints: Where `print` goes; None discards it.
        scalar: Call `reward_function` even where the module has `reward_batch`.
        first_car: Number of the first car over all processes, as prints and errors name it.

    Attributes:
        is_batch: Whether `reward_batch` is called for all cars at once.
        functions: The modules' own functions, without checks and time limit; one per car, or the one of the batch.

    Raises:
        BadInput: The module cannot be run or has no callable `reward_function` or `reward_batch`.
    """

    def __init__(
        self,
        source: RewardSource,
        n_cars: int,
        time_limit_s: float,
        prints: RewardPrints | None,
        scalar: bool = False,
        first_car: int = 0,
    ) -> None:
        self.source = source
        self.n_cars = n_cars
        self.time_limit_s = time_limit_s
        self._first_car = first_car
        code = compile(source_with_constants(source), source.path, "exec", dont_inherit=True)
        # Names that the module binds at its top level are listed in its code.
        self.is_batch = not scalar and "reward_batch" in code.co_names
        name = "reward_batch" if self.is_batch else "reward_function"
        cars = [None] if self.is_batch else list(range(n_cars))
        try:
            with TimeLimit(time_limit_s):
                self.functions = [self._load(code, name, prints, car) for car in cars]
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            how = "" if isinstance(error, Unusable) else "cannot be run: "
            raise BadInput(source.path, f"{how}{what_happened(error, source.path)}") from error
        self._track_params: Sequence[TrackParams] = ()
        self._waypoints: list[np.ndarray] = []

    def __call__(
        self,
        columns: Mapping[str, np.ndarray],
        track_params: Sequence[TrackParams],
        active: NDArray[np.bool_] | None = None,
        track_index: NDArray[np.intp] | None = None,
    ) -> NDArray[np.float64]:
        """Return the reward of every car, shape (n_cars,); 0 for the cars that are not active.

        A module with `reward_batch` takes any number of cars.

        Args:
            columns: `params.BATCH_COLUMNS`, each (n_cars,), `closest_waypoints` (n_cars, 2), and with others on the
                road `params.MASK` and `params.OBJECT_COLUMNS`.
            track_params: Params that are constant on each of the courses.
            active: Cars to reward, shape (n_cars,); None: all.
            track_index: Index in `track_params` of each car's course, shape (n_cars,); None: all drive on the first.

        Raises:
            RewardFailed: The function raised, timed out, or returned no finite number within +-`MAX_REWARD`.
        """
        n = len(columns["x"])
        rewards = np.zeros(n)
        cars = np.arange(n) if active is None else np.flatnonzero(active)
        if len(cars):
            track_of = np.zeros(len(cars), np.intp) if track_index is None else track_index[cars]
            if len(track_params) > 1:
                order = np.argsort(track_of, kind="stable")
                cars, track_of = cars[order], track_of[order]
            call = self._call_batch if self.is_batch else self._call_each
            rewards[cars] = call(columns, track_params, track_of, cars)
        return rewards

    def answers(self, calls: Iterable[dict[str, Any]]) -> Iterator["float | Failure"]:
        """Yield the reward of the first car's module (`scalar`) for each of the params, or why there is none."""
        function = self.functions[0]
        return answers(
            lambda params: _as_reward(function(params)), calls, self.source.path, self.time_limit_s
        )

    def _load(
        self, code: CodeType, name: str, prints: RewardPrints | None, car: int | None
    ) -> Callable[[dict[str, Any]], object]:
        printer = (
            _discard if prints is None else prints.printer(None if car is None else self._first_car + car)
        )
        namespace: dict[str, Any] = {
            "__name__": "reward_function",
            "__file__": self.source.path,
            "print": printer,
        }
        run_module(code, namespace)
        function = namespace.get(name)
        if not callable(function):
            raise Unusable(f"{name} is {_short(function)}; accepted: a function")
        return function

    def _call_each(
        self,
        columns: Mapping[str, np.ndarray],
        track_params: Sequence[TrackParams],
        track_of: NDArray[np.intp],
        ids: NDArray[np.intp],
    ) -> list[float]:
        functions, cars, selected = self.functions, ids.tolist(), select(columns, ids)
        rewards: list[float] = []
        table, own_params = list(rows(selected)), [track_params[place] for place in track_of.tolist()]
        keys = row_keys(selected)
        try:
            with TimeLimit(self.time_limit_s):
                for car, road, row in zip(cars, own_params, table, strict=True):
                    reward = functions[car](scalar_params(row, road, keys))
                    # A float within the bounds needs no further check; NaN fails the comparison.
                    if type(reward) is not float or not -MAX_REWARD <= reward <= MAX_REWARD:
                        reward = _as_reward(reward)
                    rewards.append(reward)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001 - raised again as one of ours
            # There is a reward for each car so far; the time limit may be exceeded right after the last one.
            failed = min(len(rewards), len(cars) - 1)
            self._fail(error, cars[failed], scalar_params(table[failed], own_params[failed], keys))
        return rewards

    def _call_batch(
        self,
        columns: Mapping[str, np.ndarray],
        track_params: Sequence[TrackParams],
        track_of: NDArray[np.intp],
        ids: NDArray[np.intp],
    ) -> NDArray[np.float64]:
        """Call the function once per course; the cars of a course are adjacent."""
        if track_params is not self._track_params:
            self._track_params = track_params
            self._waypoints = [np.array(road.waypoints, dtype=float).reshape(-1, 2) for road in track_params]
        rewards = np.empty(len(ids))
        bounds = [0, len(ids)]
        if len(track_params) > 1:
            bounds[1:1] = (np.flatnonzero(np.diff(track_of)) + 1).tolist()

        def params(first: int, last: int) -> dict[str, Any]:
            place = track_of[first]
            return batch_params(select(columns, ids[first:last]), track_params[place], self._waypoints[place])

        ends = (0, len(ids))
        try:
            with TimeLimit(self.time_limit_s):
                for ends in itertools.pairwise(bounds):
                    returned = self.functions[0](params(*ends))
                    rewards[slice(*ends)] = _as_rewards(returned, ends[1] - ends[0])
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001 - raised again as one of ours
            self._fail(error, None, params(*ends))
        accepted = np.abs(rewards) <= MAX_REWARD
        if not accepted.all():
            bad = int(accepted.argmin())
            selected, road = select(columns, ids[bad : bad + 1]), track_params[track_of[bad]]
            no_reward = Unusable(_no_reward(float(rewards[bad])))
            row = next(iter(rows(selected)))
            self._fail(no_reward, int(ids[bad]), scalar_params(row, road, row_keys(selected)))
        return rewards

    def _fail(self, error: BaseException, car: int | None, params: dict[str, Any]) -> NoReturn:
        """Raise RewardFailed for an error of the function."""
        function = "reward_batch" if self.is_batch else "reward_function"
        number = None if car is None else self._first_car + car
        where = f"{len(params['steps'])} cars" if car is None else f"car {number}, step {params['steps']:g}"
        what = what_happened(error, self.source.path)
        message = f"reward {self.source.name}: {function} {what} ({where})"
        raise RewardFailed(message, params, car, what) from error


@dataclass(frozen=True)
class Failure:
    """A call of a reward function that failed."""

    what: str
    """The function's mistake and its line."""
    params: dict[str, Any]
    """The params of the call."""
    error: BaseException

    @property
    def hung(self) -> bool:
        """Whether the time limit was exceeded."""
        return isinstance(self.error, TimeLimitPassed)

    @property
    def returned(self) -> bool:
        """Whether it returned something that is not a reward, so that `what` has no line."""
        return isinstance(self.error, Unusable)


def answers(
    function: Callable[[dict[str, Any]], Value],
    calls: Iterable[dict[str, Any]],
    path: str,
    time_limit_s: float,
) -> Iterator[Value | Failure]:
    """Call a function of a reward module with each of the params in their order, and yield its results.

    `path` is the module's, for the line of an error; the limit is of each call.
    """
    for params in calls:
        before = dict(params)  # the function may change them
        try:
            with TimeLimit(time_limit_s):
                answer: Value | Failure = function(params)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001 - of the module's code
            answer = Failure(what_happened(error, path), before, error)
        yield answer


class Unusable(Exception):  # noqa: N818 - reads as what it is at the raise site
    """A reward module returned or defined something that cannot be used."""


def what_happened(error: BaseException, path: str) -> str:
    """Describe an error of the code of module `path` in one line with its place."""
    if isinstance(error, Unusable):
        return str(error)
    raised = what_was_raised(error, path)
    return raised.removeprefix("raised TimeLimitPassed: ") if isinstance(error, TimeLimitPassed) else raised


def _as_reward(value: object) -> float:
    """Return `float(value)`, as AWS computes it; text is refused, although `float("1")` would work."""
    if isinstance(value, str | bytes | bytearray):
        raise Unusable(_no_reward(value))
    try:
        reward = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError) as error:
        raise Unusable(_no_reward(value)) from error
    if not math.fabs(reward) <= MAX_REWARD:
        raise Unusable(_no_reward(value))
    return reward


def _as_rewards(value: object, n: int) -> NDArray[np.float64]:
    try:
        rewards = np.asarray(value)
    except ValueError as error:  # rows of different lengths
        raise Unusable(_no_reward(value)) from error
    if rewards.shape != (n,) or rewards.dtype.kind not in "biuf":
        shape = f"{rewards.dtype} of shape {rewards.shape}"
        raise Unusable(f"returned {shape}; accepted: one number per car, shape ({n},)")
    return rewards.astype(np.float64)


def _no_reward(value: object) -> str:
    return f"returned {_short(value)}; accepted: a finite number from {-MAX_REWARD:g} to {MAX_REWARD:g}"


def _short(value: object) -> str:
    return _one_line(reprlib.repr(value))


def _one_line(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 300 else f"{text[:300]}..."


def _discard(*values: object, **options: object) -> None:
    """Stand in for `print` where there is no log."""
