"""Results that several figures and findings share."""

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

if TYPE_CHECKING:
    from .log_view import LogView

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def once_per_view(
    find: "Callable[Concatenate[LogView, Arguments], Result]",
) -> "Callable[Concatenate[LogView, Arguments], Result]":
    """Cache the results of a function of a view, and of hashable arguments, with the view."""
    results: WeakKeyDictionary[LogView, dict[Any, Result]] = WeakKeyDictionary()

    @wraps(find)
    def kept(view: "LogView", *args: Arguments.args, **more: Arguments.kwargs) -> Result:
        of_view = results.setdefault(view, {})
        key = (args, tuple(more.items()))
        if key not in of_view:
            of_view[key] = find(view, *args, **more)
        return of_view[key]

    return kept
