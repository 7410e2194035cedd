"""Imported last by the fork server only: makes the slow first compiled call, so that forked workers need not.

That call loads numba's runtime, which takes a third of a second. The server does so while the training process still
imports; workers would do so while the training waits.
"""

import gc

import numpy as np

from deepracer_exp.tracks.segments import build_segments

build_segments(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]))
gc.freeze()  # a collection in a worker would copy the server's memory
