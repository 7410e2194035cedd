"""TorchRL without what a command never uses of it: PyTorch's compiler and Ray, half of the seconds of its import."""

import contextlib
import gc
import importlib
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

_FIRST = ("tensordict", "torchrl")
"""One of them is imported first, whatever is asked for; TorchRL imports the other at its own beginning."""
_USED = ("checkpoint", "collectors", "data", "envs", "modules", "objectives", "weight_update")
"""Modules of TorchRL that are imported with it."""
_COMPILER = "torch._dynamo"
_RAY = "ray"
_RARELY = 400_000
"""New objects between two collections of garbage. Imports make half a million, of which none is garbage; at Python's
usual 700, looking at them again and again takes a fifth of the imports' time."""
_OPTIMIZER_METHODS = ("add_param_group", "load_state_dict", "state_dict", "zero_grad")
"""Methods of every optimizer that import the compiler at their first call."""


def import_lean() -> None:
    """Have TorchRL imported without PyTorch's compiler and Ray, when this process first asks for it.

    TorchRL marks functions for the compiler, which loads all of it, and looks whether Ray is installed by importing it.
    A program that compiles loads the real compiler later; functions of TorchRL lack their marks there, and are run as
    they stand. TorchRL's own classes for Ray are unusable, which are not used here.
    """
    if not any(name in sys.modules for name in _FIRST):
        sys.meta_path.insert(0, _LeanTorchRL(gc.get_threshold()))
        gc.set_threshold(_RARELY)


@contextlib.contextmanager
def not_imported(package: str) -> Iterator[None]:
    """Have a package not imported within the block, as if it were not installed; of no effect where it is already."""
    if package in sys.modules:
        yield
        return
    sys.modules[package] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules[package]


class _LeanTorchRL(MetaPathFinder):
    """Finds the first module of TorchRL, and imports the others with it."""

    def __init__(self, garbage_threshold: tuple[int, ...]):
        """Set `garbage_threshold` for collections of garbage once TorchRL is imported."""
        self._garbage_threshold = garbage_threshold

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in _FIRST:
            return None
        spec = PathFinder.find_spec(fullname, path)
        if spec is None or spec.loader is None:
            return None
        execute = spec.loader.exec_module

        sys.meta_path.remove(self)

        def execute_all(module: ModuleType) -> None:
            with _placeholders():
                execute(module)
                for name in _USED:
                    importlib.import_module(f"torchrl.{name}")
            _keep_lean()
            gc.freeze()
            gc.set_threshold(*self._garbage_threshold)

        spec.loader.exec_module = execute_all  # type: ignore[method-assign]
        return spec


@contextlib.contextmanager
def _placeholders() -> Iterator[None]:
    """Have PyTorch's compiler and Ray not imported within the block."""
    import torch

    if _COMPILER not in sys.modules:
        sys.modules[_COMPILER] = torch._dynamo = _CompilerPlaceholder(_COMPILER)
    try:
        with not_imported(_RAY):
            yield
    finally:
        if isinstance(placeholder := sys.modules.get(_COMPILER), _CompilerPlaceholder):
            placeholder.remove()


def _keep_lean() -> None:
    """Have optimizers not import the compiler at their first call, and TensorDict not pandas at its first tensor."""
    from tensordict import TensorDictBase
    from torch import Tensor
    from torch.optim import Optimizer

    for name in _OPTIMIZER_METHODS:
        method = getattr(Optimizer, name).__wrapped__
        # Where PyTorch keeps the method as the compiler has wrapped it.
        method.__dynamo_disable = method

    convert = TensorDictBase.from_any.__func__

    def from_any(cls: type, obj: Any, **options: Any) -> Any:
        # TensorDict's own looks whether the tensor is a table of pandas before it returns it.
        return obj if isinstance(obj, Tensor) else convert(cls, obj, **options)

    TensorDictBase.from_any = classmethod(from_any)


class _CompilerPlaceholder(ModuleType):
    """What modules need of the compiler while they are imported; for all else the real one is imported."""

    @staticmethod
    def allow_in_graph(function: Callable[..., Any]) -> Callable[..., Any]:
        return function

    @staticmethod
    def assume_constant_result(function: Any) -> Any:
        function._dynamo_marked_constant = True
        return function

    @staticmethod
    def disable(function: Any = None, recursive: bool = True, **options: Any) -> Any:
        return function if function is not None else lambda decorated: decorated

    def remove(self) -> None:
        """Let the next import load the real compiler."""
        import torch

        del sys.modules[_COMPILER]
        del torch._dynamo

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        self.remove()
        return getattr(importlib.import_module(_COMPILER), name)
