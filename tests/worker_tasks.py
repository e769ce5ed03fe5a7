"""Tasks that end badly, in a module that a worker imports in no time."""

import os
import signal
import time

KILL = getattr(signal, "SIGKILL", signal.SIGTERM)  # on Windows, SIGTERM ends a process at once


def always_die():
    """A task that no worker survives."""
    os.kill(os.getpid(), KILL)


def note(folder, number):
    """A task that leaves a file when it begins, and takes a while."""
    (folder / str(number)).touch()
    time.sleep(0.2)
    return number
