"""Imported first by the fork server, from which workers are forked, and by nothing else.

The server ends once all its clients are gone. On its own it would look only after it has imported what its workers
need, which takes many seconds on a busy machine.
"""

import os
from pathlib import Path

from deepracer_exp.lifeline import kill_when_closed

# Its clients hold the other end; it is the only pipe that the server is given (multiprocessing.forkserver).
(_clients,) = (
    int(path.name) for path in Path("/proc/self/fd").iterdir() if int(path.name) > 2 and path.is_fifo()
)
kill_when_closed(_clients, os.getpid())
