"""Imported last by the fork server, and by nothing else: makes the slow first compiled call of a process.

numba then loads its runtime, a third of a second, which the server does while the training process imports; each worker
would do it while the training waits.
"""

import gc

import numpy as np

from deepracer_exp.tracks.segments import build_segments

build_segments(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]))
gc.freeze()  # a collection in a worker would copy the server's memory
