"""Signs of life of a collector's workers on a Ray cluster."""


class Beats:
    """Knows how many control steps each worker has done; an actor of its own, because the others are driving."""

    def __init__(self) -> None:
        self._steps: dict[int, int] = {}

    def tell(self, worker: int, steps: int) -> None:
        """Take a worker's sign of life."""
        self._steps[worker] = steps

    def steps(self) -> dict[int, int]:
        """Return the control steps of the workers that have told of any."""
        return self._steps
