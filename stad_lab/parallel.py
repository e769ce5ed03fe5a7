"""Worker processes: one way to start them for collecting, evolving and evaluating.

Any `concurrent.futures.Executor` serves; this is the one a laptop has built in.
"""

import ctypes
import functools
import multiprocessing
import os
import platform
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import cv2
import torch

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # from glibc's malloc.h


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


def keep_freed_memory() -> None:
    """Tell the C library to keep the memory that this process frees, instead of giving it back to the system.

    A batch's arrays have the sizes of the batch before. Without this, Linux takes the same pages back, clears them and
    hands them out again in every step. It holds until the process ends; elsewhere than on Linux with glibc nothing
    happens.
    """
    if has_glibc():
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_MAX, 0)
        library.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def return_freed_memory(above: float = 2e9) -> None:
    """Give freed memory back to the system after all, if the process holds more than so many bytes.

    Kept memory is chopped up in time: training M at paper scale would hold some 15 MB more after every step.
    """
    if has_glibc() and int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") > above:
        ctypes.CDLL(None).malloc_trim(0)


@functools.cache
def has_glibc() -> bool:
    """Whether this is Linux with the GNU C library."""
    return sys.platform == "linux" and platform.libc_ver()[0] == "glibc"


def peak_memory() -> dict[str, float] | None:
    """The most memory, in MB, that this process and the largest of its ended workers have held; None on Windows.

    The worker's figure is an upper bound: on Linux a process begins with that of the process that started it.
    """
    if sys.platform == "win32":
        return None
    import resource  # is not there on Windows

    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kilobytes on Linux
    most = {"process": resource.RUSAGE_SELF, "worker": resource.RUSAGE_CHILDREN}
    most = {name: resource.getrusage(who).ru_maxrss * unit / 1e6 for name, who in most.items()}
    if sys.platform == "linux":
        status = Path("/proc/self/status").read_text()
        most["process"] = int(status.split("VmHWM:")[1].split()[0]) * unit / 1e6
    return {name: round(value, 1) for name, value in most.items()}


def start_worker() -> None:
    """Prepare a worker process."""
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent() -> None:
    """Wait until the parent process has ended, then end this one: a killed parent must not leave workers behind."""
    multiprocessing.parent_process().join()
    os._exit(1)
