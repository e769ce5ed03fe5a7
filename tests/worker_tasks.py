"""Tasks that end badly. They lie apart, for a worker imports the module of its task, and this one takes no time."""

import os
import signal
import time

KILL = getattr(signal, "SIGKILL", signal.SIGTERM)  # on Windows, SIGTERM ends a process at once


def die_once(marker, answer):
    """A task whose first worker is killed."""
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), KILL)
    return answer


def hang_once(marker, answer):
    """A task whose first worker never ends."""
    if not marker.exists():
        marker.touch()
        time.sleep(10_000)
    return answer


def always_die():
    """A task that no worker survives."""
    os.kill(os.getpid(), KILL)
