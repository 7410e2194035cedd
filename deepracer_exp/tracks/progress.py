"""Progress along the lap as the DeepRacer service counts it."""

import numpy as np


def progress(
    ndist: np.ndarray, start_ndist: np.ndarray, previous: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return progress in per cent and the value to pass as `previous` at the next step.

    The rule is that of deepracer-simapp (agent_ctrl/utils.py): a fall by more than half a lap means that
    the start line was passed forwards, a rise by more than half a lap that the car rolled back over it.

    Args:
        ndist: Normalised projections on the centre line, 0 to 1, of any shape.
        start_ndist: Where each episode began, 0 to 1.
        previous: Second result of the step before; 0 at an episode's first step.

    Returns:
        Progress (at most 100; below 0 behind the start), and the next `previous` (0 after a full lap).
    """
    p = 100.0 * (ndist - start_ndist)
    p = np.where(p <= 0.0, p + 100.0, p)
    p = np.where(previous > p + 50.0, p + 100.0, p)
    p = np.where(p > previous + 50.0, p - 100.0, p)
    p = np.minimum(p, 100.0)
    return p, np.where(p == 100.0, 0.0, p)
