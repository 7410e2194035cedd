"""Imported first by the fork server, from which workers are forked, and by nothing else.

Workers end with the server (`end_with_owner`), and the server with the process that started it.
"""

import signal

from deepracer_exp.lifeline import die_with_parent

from .forking import SIGNALS

die_with_parent()
for signum in SIGNALS:
    signal.signal(signum, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
