"""Imported by the process that workers are forked from, and by nothing else.

Workers keep the fork server's pipe open, so that on its own it would wait for the last of them when the training
process is killed, and a worker that hangs would stay for ever. Hence the kernel ends the server with the training
process, and the workers with the server.
"""

import os

from . import worker  # noqa: F401 - what takes long to import, once for all workers
from .lifeline import die_with_parent

die_with_parent()
os.register_at_fork(after_in_child=die_with_parent)
