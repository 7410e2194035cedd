"""Call a reward function as deepracer-on-aws' validator does, and say what the validator would refuse."""

import builtins
import dis
import inspect
import math
import reprlib
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

import numpy as np

from deepracer_exp.rewards.guard import CtrlC, DeadlinePassed, Guard
from deepracer_exp.rewards.reward import MAX_REWARD, Unusable, run_module, what_happened
from deepracer_exp.rewards.source import RewardSource, source_with_constants
from deepracer_exp.tracks.track import Track

from .aws_rules import AwsFinding
from .probe import Coverage

_LIMIT_S = 5.0
_OBJECTS = 6
_IMPORT_NAME = dis.opmap["IMPORT_NAME"]
_METHODS = "numpy._core._methods"
_ARRAY_METHODS = (
    "methods of arrays, such as x.sum(), x.max(), x.all(), do that; functions, such as np.sum(x), do not"
)


class _LateImport(Exception):  # noqa: N818 - reads as what it is at the raise site
    """An import statement was executed while the function was called."""


def dry_run_findings(source: RewardSource, track: Track) -> list[AwsFinding]:
    """Return the reasons why the validator would refuse a function after calling it; empty if it would accept it.

    The module is loaded once for all calls and, as there, run again in the same namespace before each of them: what
    only a function has assigned (`global`) is kept.
    """
    module = _Module(source)
    module.run()
    module.check_signature()
    if module.error is None:
        module.find_imports(validator_params(track)["at the start"])
        for name, params in validator_params(track).items():
            module.call(name, params)
    return module.findings()


class _Module:
    """A reward module in a namespace of its own, and what is wrong with it."""

    def __init__(self, source: RewardSource) -> None:
        self._path = source.path
        self._code = compile(source_with_constants(source), source.path, "exec", dont_inherit=True)
        self._namespace: dict[str, Any] = {"__name__": "reward_function", "print": _format}
        self._found: list[AwsFinding] = []
        self._wrong: dict[str, list[str]] = {}
        self._hangs = False
        self.error: str | None = None

    def run(self) -> None:
        """Run the module's text in its namespace."""
        try:
            with Guard(_LIMIT_S):
                run_module(self._code, self._namespace)
        except CtrlC:
            raise
        except BaseException as error:  # noqa: BLE001 - of the module's code
            self.error = f"cannot be imported: {self._what_happened(error)}"

    def check_signature(self) -> None:
        """Find what is no function, or one that has not exactly one parameter."""
        if self.error is not None:
            return
        function = self._namespace.get("reward_function")
        if not inspect.isfunction(function):
            self.error = f"reward_function is {reprlib.repr(function)}, no function"
            return
        signature = inspect.signature(function)
        if len(signature.parameters) != 1:
            text = f"reward_function{signature}: exactly one parameter is accepted, reward_function(params)"
            self._found.append(AwsFinding(0, text))

    def find_imports(self, params: dict[str, Any]) -> None:
        """Find imports that are executed while the function is called; its other errors are those of `call`."""
        self.run()
        late: dict[str, int] = {}
        try:
            with Guard(_LIMIT_S):
                _noting_imports(self._namespace["reward_function"], self._path, late)(params)
        except CtrlC:
            raise
        except BaseException:  # noqa: BLE001 - of the module's code, which `call` reports
            pass
        for name, line in late.items():
            why = _ARRAY_METHODS if name == _METHODS else "imports belong at the top of the file"
            text = f"{name} is imported while the function is called; {why}"
            self._found.append(AwsFinding(line, text, "documented" if line else "validator"))

    def call(self, name: str, params: dict[str, Any]) -> None:
        """Call the function in the situation `name`, after running the module again; not after it has hung."""
        if self._hangs:
            return
        self.run()
        try:
            with Guard(_LIMIT_S):
                reward = self._namespace["reward_function"](dict(params))
                # The subclass np.float64 is one; a bool, an int or np.float32 is not.
                if isinstance(reward, float) and -MAX_REWARD <= reward <= MAX_REWARD:
                    return
                returned = f"returned {reprlib.repr(reward)} of type {type(reward).__name__}"
            line = self._line_of_return(params)
            raise Unusable(
                f"line {line} {returned}; accepted: a float from {-MAX_REWARD:g} to {MAX_REWARD:g}"
            )
        except CtrlC:
            raise
        except BaseException as error:  # noqa: BLE001 - of the module's code
            self._hangs = isinstance(error, DeadlinePassed)
            self._wrong.setdefault(self._what_happened(error), []).append(name)

    def _what_happened(self, error: BaseException) -> str:
        return what_happened(error, self._path, _LIMIT_S)[0]

    def _line_of_return(self, params: dict[str, Any]) -> int | None:
        self.run()
        with Guard(_LIMIT_S), Coverage(self._path) as coverage:
            self._namespace["reward_function"](dict(params))
        return coverage.returned_at

    def findings(self) -> list[AwsFinding]:
        """Return what is wrong, each kind once with the situations in which it is."""
        if self.error is not None:
            return [AwsFinding(0, self.error)]
        wrong = (f"{what}, called {', '.join(names)}" for what, names in self._wrong.items())
        return [*self._found, *(AwsFinding(0, text) for text in wrong)]


def _noting_imports(
    function: Callable[..., object], path: str, late: dict[str, int]
) -> Callable[[dict[str, Any]], object]:
    """Return the function so that an import while it is called is noted in `late` and, if it is a statement, fails.

    `late` gets names of modules and lines of the function's file `path`; 0 for a library's, which counts, too. An
    import by code in C is only noted, because some of it crashes if it fails.
    """

    def noted(name: str, *args: Any, **options: Any) -> object:
        caller = sys._getframe(1)
        if caller.f_code.co_code[caller.f_lasti] == _IMPORT_NAME:
            late[name] = caller.f_lineno if caller.f_code.co_filename == path else 0
            raise _LateImport(name)
        if not name.startswith("numpy."):  # in these, versions of NumPy differ
            late[name] = 0
        return importing(name, *args, **options)

    def called(frame: FrameType, event: str, _: object) -> None:
        # This process has imported the module already; there, the first method of an array that needs it does.
        if event == "call" and frame.f_globals.get("__name__") == _METHODS and frame.f_back is not None:
            caller = frame.f_back
            by_name = "_methods" in caller.f_code.co_names or caller.f_globals is frame.f_globals
            if not by_name:  # but by code in C, which imports it
                late[_METHODS] = 0

    importing, profile = builtins.__import__, sys.getprofile()

    def call(params: dict[str, Any]) -> object:
        builtins.__import__ = noted  # type: ignore[assignment]
        sys.setprofile(called)
        try:
            return function(params)
        finally:
            sys.setprofile(profile)
            builtins.__import__ = importing

    return call


def _format(*values: object, **_: object) -> None:
    """Stand in for `print`: what is printed must be printable there, too."""
    for value in values:
        str(value)


def validator_params(track: Track) -> dict[str, dict[str, Any]]:
    """Return the params with which the validator calls a function, by situation.

    They are not those of a training: 24 of the 27 keys, some numbers are integers, `waypoints` is an array (n, 2) of
    the inner border, the track is reversed, and six objects stand on it. Source: get_params in deepracer-on-aws,
    test_reward_function.py; the objects are placed evenly here.
    """
    inner, outer, center = track.inner, track.outer, track.waypoints
    n = len(inner)
    width_m = math.dist(inner[0], outer[0])
    to_outer = (outer[0] - center[0]) / math.dist(outer[0], center[0])
    beside = center[0] + to_outer * width_m
    waypoint = np.linspace(0, n, _OBJECTS, endpoint=False, dtype=np.intp)
    distances_m = track.length_m * (waypoint + 1) / n

    def params(
        x_y: np.ndarray,
        progress: int,
        steps: int,
        speed: float,
        steering_angle: float,
        heading: float = 359.9,
        closest_waypoints: tuple[int, int] = (0, 1),
        is_offtrack: bool = False,
    ) -> dict[str, Any]:
        return {
            "all_wheels_on_track": not is_offtrack,
            "x": x_y[0],
            "y": x_y[1],
            "distance_from_center": width_m if is_offtrack else 0,
            "heading": heading,
            "progress": progress,
            "steps": steps,
            "speed": speed,
            "steering_angle": steering_angle,
            "track_width": width_m,
            "waypoints": inner.copy(),
            "closest_waypoints": list(closest_waypoints),
            "is_left_of_center": True,
            "is_reversed": True,
            "track_length": float(np.hypot(*np.diff(inner, axis=0).T).sum()),
            "closest_objects": [0, 1],
            "objects_location": center[waypoint].tolist(),
            "objects_left_of_center": [True, True, False, True, False, True],
            "object_in_camera": True,
            "objects_speed": [0.2] * _OBJECTS,
            "objects_heading": np.linspace(-2.0, 2.0, _OBJECTS).tolist(),
            "objects_distance": distances_m.tolist(),
            "is_crashed": False,
            "is_offtrack": is_offtrack,
        }

    return {
        "at the start": params((inner[0] + center[0]) / 2, 0, 1, 0.5, 6, 0),
        "on the start line": params(inner[0], 0, 1, 0.1, 0.2, 0),
        "half-way": params(inner[n // 2], 50, 100, 1.0, 6, closest_waypoints=(3, 4)),
        "off the track": params(beside, 0, 1, 1, 15, is_offtrack=True),
        "at the finish": params(inner[-1], 100, 10_000, 5.0, 0, closest_waypoints=(n - 2, n - 1)),
    }
