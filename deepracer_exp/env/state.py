"""Arrays of cars that come back out of a checkpoint."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from deepracer_exp.errors import BadInput


def fitting(state: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return a copy of the array `name` of a state_dict.

    Raises:
        BadInput: there is none, or it has another shape.
    """
    array = state.get(name)
    found = f"shape {array.shape}" if isinstance(array, np.ndarray) else "no array"
    if not isinstance(array, np.ndarray) or array.shape != shape:
        raise BadInput(
            f"the checkpoint does not fit: '{name}' of its cars has {found}, these cars need {shape}; accepted: a "
            "checkpoint of as many cars, on the same tracks, with the same features"
        )
    return array.copy()
