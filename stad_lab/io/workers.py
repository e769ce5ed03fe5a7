"""Worker processes: who drives the cars for collecting, evolving and evaluating.

Any `concurrent.futures.Executor` serves; `WorkerProcesses` is that of one machine. What a task
returns depends on its arguments alone, so the work of a lost worker is simply done again.
"""

import functools
import itertools
import multiprocessing
import operator
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

import cv2
import torch
from tqdm.auto import tqdm

import stad_lab

PRELOADED = ["stad_lab.training.pipeline"]  # a worker's imports take 2 to 4 seconds
PATIENCE = 3600.0  # seconds without any finished task, after which the workers count as stuck
SLICES = 60  # in which the waiting is counted, so that a suspended machine loses one slice
LOSSES = 3  # pools that may be lost in a row


class TaskError(RuntimeError):
    """A task failed in a worker, or none was finished for too long."""


class WorkerProcesses(Executor):
    """A pool of fresh Python processes with one thread each, that outlives its workers.

    When a worker is killed, Python's own pool is broken for good: a new one then takes over what
    was not finished.

    Raises:
        ValueError: fewer than 1 process, or a script that workers cannot import.
    """

    def __init__(self, count: int):
        check_script()
        if count < 1:
            raise ValueError(f"processes={count}: expected at least 1, such as the number of cores")
        self.count, self.losses, self.closed = count, 0, False
        self.lock = threading.RLock()
        self.pool = self._new_pool()
        self.lost: list[ProcessPoolExecutor] = []  # referenced: dropping a broken one can deadlock

    def submit(self, function: Callable, /, *arguments, **named) -> Future:
        """As for every Executor."""
        task = Future()
        self._begin(task, Work(task, functools.partial(function, *arguments, **named)))
        return task

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """As for every Executor."""
        self.closed = True
        self.pool.shutdown(wait, cancel_futures=cancel_futures)

    def stop(self) -> None:
        """End the processes at once."""
        self.closed = True
        for process in list((self.pool._processes or {}).values()):  # there is no public name
            process.kill()
        # A worker that dies while it sends a result leaves half of it, and the pool waits for the
        # rest as long as anybody could write it: forever, because this process could.
        if results := self.pool._result_queue:
            results._writer.close()

    def _new_pool(self) -> ProcessPoolExecutor:
        # Not "fork": copies of this process would lack PyTorch's threads.
        context = multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")
        if sys.platform == "linux":
            context.set_forkserver_preload(PRELOADED)
        count = min(self.count, 61) if sys.platform == "win32" else self.count  # Windows' limit
        return ProcessPoolExecutor(count, mp_context=context, initializer=start_worker)

    def _begin(self, task: Future, work: "Work") -> None:
        pool = self.pool
        try:
            attempt = pool.submit(work)
        except Exception as error:  # it broke a moment ago, or no process can be started
            attempt = Future()
            attempt.set_exception(error)
        attempt.add_done_callback(functools.partial(self._end, task, work, pool))

    def _end(self, task: Future, work: "Work", pool: ProcessPoolExecutor, attempt: Future) -> None:
        if attempt.cancelled():
            task.cancel()
        error = None if task.cancelled() else attempt.exception()
        if isinstance(error, BrokenProcessPool) and not self.closed:
            try:
                if self._replace(pool):
                    self._begin(task, work)
                    return
            except OSError as failure:  # no process can be started
                error = failure
        if not task.set_running_or_notify_cancel():  # tells those who wait for a cancelled task
            return
        if error is None:
            self.losses = 0
            task.set_result(attempt.result())
        else:
            task.set_exception(error)

    def _replace(self, lost: ProcessPoolExecutor) -> bool:
        """Start a new pool for a lost one, unless that is done; False after too many losses."""
        with self.lock:
            if lost is self.pool:
                self.losses += 1
                if self.losses > LOSSES:
                    return False
                print("a worker process was lost: its work is done again", file=sys.stderr)
                self.lost.append(lost)
                self.pool = self._new_pool()
            return True


def check_script() -> None:
    """Raise ValueError if workers, which import the running script, would run all of it again."""
    script = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    if script.is_file() and "__main__" not in script.read_text(errors="replace"):
        raise ValueError(
            f"{script} would run again in every worker process: put what it does below a line"
            ' `if __name__ == "__main__":`'
        )


class Work:
    """What a worker does for a task: nothing if the task is cancelled before it is sent.

    To cancel the pool's own future instead would stop a pool that breaks from ending (Python 3.11).
    """

    def __init__(self, task: Future, call: Callable):
        self.task, self.call = task, call

    def __reduce__(self):
        sent = (int,) if self.task.cancelled() else (run_here, stad_lab.__file__, self.call)
        return functools.partial, sent


def run_here(home: str, call: Callable) -> object:
    """Call a function in a worker, which must have loaded the same stad_lab as its parent."""
    if stad_lab.__file__ != home:
        raise ValueError(
            f"a worker process loaded {stad_lab.__file__}, its parent {home}: install the one that"
            " you use instead of changing sys.path"
        )
    return call()


@contextmanager
def worker_processes(count: int, given: Executor | None = None) -> Iterator[Executor]:
    """A pool of `count` processes for a `with` block; or the given executor, which stays open.

    The processes ignore Ctrl-C and end with their parent. If the block is left by an interrupt or
    an error, they are stopped at once.
    """
    if given is not None:
        yield given
        return
    executor = WorkerProcesses(count)
    try:
        yield executor
    except BaseException:
        executor.stop()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def run_tasks(
    executor: Executor,
    function: Callable,
    tasks: list[tuple],
    ahead: int | None = None,
    patience: float = PATIENCE,
) -> Iterator[tuple[int, object]]:
    """Call `function(*task)` for every task; yields (its number, its result) as they finish.

    Args:
        ahead: how many tasks may have begun whose results were not yielded yet; None: all.
        patience: seconds without a finished task, after which the workers count as stuck.

    Raises:
        ValueError, OSError: as raised by a task.
        TaskError: a task failed otherwise, or no task was finished for `patience` seconds.
    """
    to_begin, waiting = enumerate(tasks), {}
    name = getattr(getattr(function, "func", function), "__name__", function)
    try:
        while True:
            for number, task in itertools.islice(to_begin, (ahead or len(tasks)) - len(waiting)):
                with task_errors(name):
                    waiting[executor.submit(function, *task)] = number
            if not waiting:
                return
            done = finished_first(waiting, patience)
            while done:  # emptied, so that no result is kept
                number = waiting.pop(future := done.pop())
                with task_errors(name):
                    result = future.result()
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
        raise TaskError(
            f"{name} was cancelled, as when a scheduler is lost: the same command continues"
        ) from error
    except BrokenProcessPool as error:
        raise TaskError(
            f"{name}: {LOSSES + 1} times in a row a worker process ended abruptly; was it killed,"
            " or is memory short? The same command continues"
        ) from error
    except Exception as error:
        raise TaskError(f"{name} failed in a worker: {type(error).__name__}: {error}") from error


def finished_first(waiting: dict[Future, int], patience: float) -> set[Future]:
    """The futures that are finished, as soon as there are any. TaskError after `patience`."""
    for _ in range(SLICES):
        done, _ = wait(waiting, patience / SLICES, return_when=FIRST_COMPLETED)
        if done:
            return done
    raise TaskError(f"no worker has finished anything for {patience:.0f} seconds: see if they live")


def run_in_order(
    executor: Executor, function: Callable, tasks: list[tuple], label: str | None = None
) -> list:
    """The results of all tasks in their order; with a progress bar if it has a label."""
    finished = run_tasks(executor, function, tasks)
    bar = tqdm(finished, label, len(tasks), unit="episode", disable=label is None)
    return [result for _, result in sorted(bar, key=operator.itemgetter(0))]


def start_worker() -> None:
    """Prepare a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    single_thread()
    threading.Thread(target=end_with_parent, daemon=True).start()


def single_thread() -> None:
    """Compute on one thread from now on: tasks fill the cores, and last bits depend on threads.

    Tasks call it, so that it holds in the workers of any executor.
    """
    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    cv2.setNumThreads(1)


def end_with_parent() -> None:
    """Wait until the parent process has ended, then end this one."""
    multiprocessing.parent_process().join()
    os._exit(1)
