"""What a training needs of whatever drives its cars."""

from collections.abc import Iterator
from types import TracebackType
from typing import Any, Protocol, Self

from tensordict import TensorDictBase


class Batches(Protocol):
    """An endless source of batches [cars, T]; a context manager that leaves no process behind."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def __iter__(self) -> Iterator[TensorDictBase]: ...

    def publish_policy(self) -> None:
        """Let the next batches be driven with the policy's weights as they are now."""

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next batch depends on but the policy; empty if there is no such state."""
