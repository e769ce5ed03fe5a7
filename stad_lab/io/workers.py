"""Who drives the cars: threads for our engine, processes for Gymnasium's own environment.

The engine and PyTorch release Python's global lock, so a few threads fill the cores. Gymnasium's
environment is Python code and needs processes. Any `concurrent.futures.Executor` serves in their
place, for example that of a Dask cluster. What a task returns depends on its arguments alone.
"""

import contextlib
import contextvars
import itertools
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent import futures
from concurrent.futures import CancelledError, Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import cv2
import torch
from tqdm.auto import tqdm

import stad_lab

PRELOADED = ["stad_lab.training.evolution"]  # a worker's imports take 2 to 4 seconds
PATIENCE = 3600.0  # seconds without any finished task, after which the workers count as stuck
LONGEST = 70  # letters of the temporary folder: a socket's name in it has at most 107
SLICES = 3600  # of the waiting: a suspended machine loses one of them, not all its patience

# Set in a thread whose work nobody waits for any more; `rollout` looks at it in every frame.
CANCELLED: contextvars.ContextVar[threading.Event | None] = contextvars.ContextVar(
    "cancelled", default=None
)


class TaskError(RuntimeError):
    """A task failed in a worker, or none was finished for too long."""


def check_cancelled() -> None:
    """Raise CancelledError in a thread whose pool was stopped."""
    event = CANCELLED.get()
    if event is not None and event.is_set():
        raise CancelledError("the rollout was stopped")


def check_count(count: int) -> int:
    """The number of workers. ValueError if there are fewer than 1."""
    if count < 1:
        raise ValueError(f"processes={count}: expected at least 1, such as the number of cores")
    return count


@contextmanager
def worker_threads(count: int, given: Executor | None = None) -> Iterator[Executor]:
    """A pool of `count` threads for a `with` block; or the given executor, which stays open.

    If the block is left by an interrupt or an error, rollouts stop within a frame. ValueError if
    `count` is below 1.
    """
    if given is not None:
        yield given
        return
    cancelled, threads = threading.Event(), torch.get_num_threads()
    count = check_count(count)
    executor = futures.ThreadPoolExecutor(count, "driver", CANCELLED.set, (cancelled,))
    try:
        yield executor
    finally:
        cancelled.set()
        try:
            executor.shutdown(cancel_futures=True)
        finally:
            torch.set_num_threads(threads)  # tasks set it to 1, for all threads that come later


class WorkerProcesses(futures.ProcessPoolExecutor):
    """A pool of processes that must load the same stad_lab as their parent."""

    def submit(self, function: Callable, /, *arguments, **named) -> Future:
        """As for every Executor."""
        return super().submit(run_here, stad_lab.__file__, function, *arguments, **named)


def run_here(home: str, function: Callable, *arguments, **named) -> object:
    """Call a function in a worker; ValueError if it has loaded another stad_lab than `home`."""
    if stad_lab.__file__ != home:
        remedy = "install the one that you use instead of changing sys.path"
        found = f"a worker process loaded {stad_lab.__file__}, its parent {home}"
        raise ValueError(f"{found}: {remedy}")
    return function(*arguments, **named)


@contextmanager
def worker_processes(count: int, given: Executor | None = None) -> Iterator[Executor]:
    """A pool of `count` fresh processes for a `with` block; or the given executor, left open.

    The processes ignore Ctrl-C and end with their parent. If the block is left by an interrupt or
    an error, they are killed. ValueError if `count` is below 1, or for a script without a line
    `if __name__ == "__main__":`, which would run again in every process.
    """
    if given is not None:
        yield given
        return
    check_script()
    # Not "fork": copies of this process would lack PyTorch's threads.
    with_server = sys.platform == "linux" and len(tempfile.gettempdir()) <= LONGEST
    context = multiprocessing.get_context("forkserver" if with_server else "spawn")
    if with_server:
        context.set_forkserver_preload(PRELOADED)
    count = min(check_count(count), 61) if sys.platform == "win32" else check_count(count)
    others = set(multiprocessing.active_children())
    executor = WorkerProcesses(count, context, start_worker)
    try:
        yield executor
    except BaseException:
        for process in set(multiprocessing.active_children()) - others:
            process.kill()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def check_script() -> None:
    """Raise ValueError if workers, which import the running script, would run all of it again."""
    script = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    if script.is_file() and "__main__" not in script.read_text(errors="replace"):
        remedy = 'put what it does below a line `if __name__ == "__main__":`'
        raise ValueError(f"{script} would run again in every worker process: {remedy}")


def start_worker() -> None:
    """Prepare a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    single_thread()
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent() -> None:
    """Wait until the parent process has ended, then end this one."""
    if parent := multiprocessing.parent_process():
        parent.join()
    os._exit(1)


def single_thread() -> None:
    """Compute on one thread from now on: tasks fill the cores, and last bits depend on threads."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


@contextmanager
def interrupted_at_the_end() -> Iterator[None]:
    """Hold an interrupt back until the end of a `with` block, where the main thread runs it."""
    if threading.current_thread() is not threading.main_thread():  # which has no interrupts
        yield
        return
    held: list[bool] = []
    before = signal.signal(signal.SIGINT, lambda *_: held.append(True))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if held:
        signal.raise_signal(signal.SIGINT)


def run_tasks(
    executor: Executor,
    function: Callable,
    tasks: list[tuple],
    ahead: int | None = None,
    patience: float = PATIENCE,
) -> Iterator[tuple[int, Any]]:
    """Call `function(*task)` for every task; yields (its number, its result) as they finish.

    Args:
        ahead: how many tasks may have begun whose results were not yielded yet; None: all.
        patience: seconds without a finished task, after which the workers count as stuck.

    Raises:
        ValueError, OSError: as raised by a task.
        TaskError: a task failed otherwise, or no task was finished for `patience` seconds.
    """
    to_begin = enumerate(tasks)
    waiting: dict[Future, int] = {}
    # An interrupt in the middle of `submit` or `futures.wait` leaves locks behind that are never
    # released, and the workers wait for them forever. `get` of this queue can be interrupted.
    finished: SimpleQueue[Future] = SimpleQueue()
    name = getattr(getattr(function, "func", function), "__name__", str(function))
    try:
        while True:
            for number, task in itertools.islice(to_begin, (ahead or len(tasks)) - len(waiting)):
                with interrupted_at_the_end(), task_errors(name):
                    waiting[future := executor.submit(function, *task)] = number
                    future.add_done_callback(finished.put)
            if not waiting:
                return
            number = waiting.pop(future := next_finished(finished, patience))
            with task_errors(name):
                result = future.result()
            del future  # or it would keep its result
            yield number, result
    finally:
        for future in waiting:
            future.cancel()


@contextmanager
def task_errors(name: str) -> Iterator[None]:
    """Turn what goes wrong with a task into a TaskError, except ValueError and OSError."""
    try:
        yield
    except (ValueError, OSError):
        raise
    except CancelledError as error:
        message = "was cancelled, as when a scheduler is lost: the same command continues"
        raise TaskError(f"{name} {message}") from error
    except BrokenProcessPool as error:
        message = "a worker process ended abruptly; was it killed, or is memory short?"
        raise TaskError(f"{name}: {message} The same command continues") from error
    except Exception as error:
        raise TaskError(f"{name} failed in a worker: {type(error).__name__}: {error}") from error


def next_finished(finished: SimpleQueue[Future], patience: float) -> Future:
    """The next future that is finished, as soon as there is one. TaskError after `patience`."""
    for _ in range(SLICES):
        with contextlib.suppress(Empty):
            return finished.get(timeout=patience / SLICES)
    raise TaskError(f"no worker has finished anything for {patience:.0f} seconds: see if they live")


def run_in_order(
    executor: Executor,
    function: Callable,
    tasks: list[tuple],
    label: str | None = None,
    unit: str = "episode",
) -> list:
    """The results of all tasks in order, with a bar if it has a label. Raises as `run_tasks`."""
    finished = run_tasks(executor, function, tasks)
    results = dict(tqdm(finished, label, len(tasks), unit=unit, disable=label is None))
    return [results[number] for number in range(len(tasks))]
