"""Worker processes: one way to start them for collecting, evolving and evaluating.

Any `concurrent.futures.Executor` serves; this is the one a laptop has built in.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager

import cv2
import torch


@contextmanager
def worker_processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of `count` fresh Python processes that compute with one thread each, for a `with` block.

    They ignore Ctrl-C (the parent decides what an interrupt means) and end themselves when the parent is gone. If the
    block is left by an interrupt or an error, they are stopped at once: nobody waits for the cars on the road.

    Raises:
        ValueError: fewer than 1 process.
    """
    if count < 1:
        raise ValueError(f"processes={count}: expected at least 1; as many as the machine has cores is a good choice")
    context = multiprocessing.get_context("spawn")  # fork and torch's threads do not go together
    executor = ProcessPoolExecutor(count, mp_context=context, initializer=start_worker)
    try:
        yield executor
    except BaseException:
        for process in list(executor._processes.values()):  # there is no public way to them before Python 3.14
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


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
