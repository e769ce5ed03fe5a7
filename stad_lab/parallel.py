"""Worker processes: one way to start them for collecting, evolving and evaluating.

Any `concurrent.futures.Executor` serves; this is the one a laptop has built in.
"""

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor

import cv2
import torch


def make_executor(processes: int) -> ProcessPoolExecutor:
    """A pool of `processes` fresh Python processes that compute with one thread each.

    They ignore Ctrl-C (the parent decides what an interrupt means) and end themselves when the parent is gone.

    Raises:
        ValueError: fewer than 1 process.
    """
    if processes < 1:
        raise ValueError(
            f"processes={processes}: expected at least 1; as many as the machine has cores is a good choice"
        )
    context = multiprocessing.get_context("spawn")  # fork and torch's threads do not go together
    return ProcessPoolExecutor(processes, mp_context=context, initializer=start_worker)


def start_worker() -> None:
    """Prepare a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent() -> None:
    """Wait until the parent process has ended, then end this one: a killed parent must not leave workers behind."""
    multiprocessing.parent_process().join()
    os._exit(1)
