"""Worker processes: one way to start them for collecting, evolving and evaluating.

Any `concurrent.futures.Executor` serves; this is the one that a laptop has built in. Work that is lost with a killed or
stuck worker is done again: what a task returns depends on its arguments alone, so nobody can tell afterwards.
"""

import ctypes
import functools
import itertools
import multiprocessing
import operator
import os
import platform
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
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

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # from glibc's malloc.h
PRELOADED = [
    "stad_lab.training.pipeline"
]  # what a worker imports: 2 to 4 seconds, of which PyTorch takes most
TIME_LIMIT = 600.0  # seconds without any finished task, after which the workers count as stuck; a task takes some 10
SLICES = 60  # in which patience is counted
LOSSES = 3  # pools that may be lost in a row, before we stop to believe that it was an accident


class TaskError(RuntimeError):
    """A task failed in a worker, or nobody has finished one for too long; the message says which and why."""


class WorkerProcesses(Executor):
    """A pool of fresh Python processes, one thread each, that outlives its workers.

    A worker that is killed breaks Python's own pool for good. Here a new pool takes over what was not finished. The
    same happens if no task is finished for `time_limit` seconds: then the workers are stuck, and are killed.

    The processes start with the first task. On Linux they are copies of a process that has imported the library and
    done nothing else, as is Python's own way from 3.14 on, so that only the first pool has to wait for the imports.

    Raises:
        ValueError: fewer than 1 process.
        RuntimeError: this is itself a worker that is just starting.
    """

    def __init__(self, count: int, time_limit: float = TIME_LIMIT):
        refuse_in_starting_worker()
        if count < 1:
            raise ValueError(
                f"processes={count}: expected at least 1; as many as the machine has cores is a good choice"
            )
        self.count, self.time_limit = count, time_limit
        self.lock, self.closed = threading.RLock(), threading.Event()
        self.losses, self.unfinished, self.silence = 0, 0, 0.0
        self.peak_memory = 0.0  # MB, of the largest process that was alive at the end
        self.pool = self._new_pool()
        self.lost: list[
            ProcessPoolExecutor
        ] = []  # kept, because one that goes wants the lock that it breaks under
        threading.Thread(target=self._watch, daemon=True).start()

    def submit(self, function: Callable, /, *arguments, **named) -> Future:
        """As for every Executor: the promise of what `function` returns."""
        task = Future()
        task.set_running_or_notify_cancel()
        with self.lock:
            self.unfinished += 1
        self._begin(task, functools.partial(function, *arguments, **named))
        return task

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """As for every Executor."""
        self.closed.set()
        for process in self._processes():
            self.peak_memory = max(self.peak_memory, most_memory(process.pid))
        self.pool.shutdown(wait, cancel_futures=cancel_futures)

    def stop(self) -> None:
        """End the processes at once, whatever they do."""
        for process in self._processes():
            process.kill()
        # Who dies while sending a result leaves half of it, and the pool's reader waits for the rest for as long as
        # anybody could still write it: for ever, because this process holds that end of the pipe as well.
        if results := self.pool._result_queue:
            results._writer.close()

    def _processes(self) -> list[multiprocessing.Process]:
        return list((self.pool._processes or {}).values())  # there is no public way to them

    def _new_pool(self) -> ProcessPoolExecutor:
        # No copies of this process: it may have threads, and those of PyTorch would be missing in the copy.
        context = multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")
        if sys.platform == "linux":
            context.set_forkserver_preload(PRELOADED)
        count = (
            min(self.count, 61) if sys.platform == "win32" else self.count
        )  # as many as Windows can wait for
        return ProcessPoolExecutor(count, mp_context=context, initializer=start_worker)

    def _begin(self, task: Future, work: Callable) -> None:
        pool = self.pool
        try:
            # Without our lock: a pool that breaks calls `_end` while it holds its own, which this wants (Python 3.12).
            attempt = pool.submit(work)
        except Exception as error:  # it broke a moment ago, or no process can be started
            attempt = Future()
            attempt.set_exception(error)
        attempt.add_done_callback(functools.partial(self._end, task, work, pool))

    def _end(
        self, task: Future, work: Callable, pool: ProcessPoolExecutor, attempt: Future
    ) -> None:
        error = (
            BrokenProcessPool("the workers were stopped")
            if attempt.cancelled()
            else attempt.exception()
        )
        try:
            if (
                isinstance(error, BrokenProcessPool)
                and not self.closed.is_set()
                and self._replace(pool)
            ):
                self._begin(task, work)
                return
        except (
            Exception
        ) as failed:  # there are no more processes or files to be had: nobody else would be told
            error = failed
        with self.lock:
            self.unfinished -= 1
            self.silence = 0.0
            self.losses = 0 if error is None else self.losses
        if error is None:
            task.set_result(attempt.result())
        else:
            task.set_exception(error)

    def _replace(self, lost: ProcessPoolExecutor) -> bool:
        """Start a new pool for a lost one, unless another task has done so already; False after too many losses."""
        with self.lock:
            if lost is self.pool:
                self.losses += 1
                if self.losses > LOSSES:
                    return False
                print(
                    "a worker process was lost: starting new ones, which do its work again",
                    file=sys.stderr,
                )
                self.lost.append(lost)
                self.pool, self.silence = self._new_pool(), 0.0
            return True

    def _watch(self) -> None:
        tick = min(
            1.0, self.time_limit / 4
        )  # counted, because a clock runs on while this process is suspended
        while not self.closed.wait(tick):
            with self.lock:
                self.silence = self.silence + tick if self.unfinished else 0.0
                if self.silence > self.time_limit:
                    told = f"no worker has finished anything for {self.silence:.0f} seconds: they are stuck"
                    print(told, file=sys.stderr)
                    self.silence = 0.0
                    self.stop()


@contextmanager
def worker_processes(
    count: int, given: Executor | None = None, time_limit: float = TIME_LIMIT
) -> Iterator[Executor]:
    """A pool of `count` processes for a `with` block; or the executor that is given, which stays open afterwards.

    The processes ignore Ctrl-C (the parent decides what an interrupt means) and end themselves when the parent is gone.
    If the block is left by an interrupt or an error, they are stopped at once: nobody waits for the cars on the road.

    Raises:
        ValueError: fewer than 1 process.
    """
    if given is not None:
        yield given
        return
    executor = WorkerProcesses(count, time_limit)
    try:
        yield executor
    except BaseException:
        executor.closed.set()
        executor.stop()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def run_tasks(
    executor: Executor,
    function: Callable,
    tasks: list[tuple],
    time_limit: float = 2 * LOSSES * TIME_LIMIT,
    ahead: int | None = None,
) -> Iterator[tuple[int, object]]:
    """Call `function(*task)` for every task, and yield (number of the task, what it returned) as they are finished.

    Args:
        ahead: how many tasks may have begun whose results are not yielded yet, for results that are large; None: all.

    Raises:
        ValueError, OSError: as raised by a task.
        TaskError: a task failed otherwise, or no task was finished for `time_limit` seconds.
    """
    to_begin, waiting = enumerate(tasks), {}
    name = getattr(getattr(function, "func", function), "__name__", function)  # a partial has none
    try:
        while True:
            for number, task in itertools.islice(to_begin, (ahead or len(tasks)) - len(waiting)):
                with task_errors(name):
                    waiting[executor.submit(function, *task)] = number
            if not waiting:
                return
            done = finished_first(waiting, time_limit)
            while done:  # emptied, so that nobody holds on to a result
                number = waiting.pop(future := done.pop())
                with task_errors(name):
                    result = future.result()
                yield number, result
    finally:
        for future in waiting:
            future.cancel()


@contextmanager
def task_errors(name: str) -> Iterator[None]:
    """Turn what goes wrong with a task called `name` into a TaskError, but for ValueError and OSError."""
    try:
        yield
    except (ValueError, OSError):
        raise
    except CancelledError as error:
        raise TaskError(
            f"{name} was cancelled, as when a scheduler is lost: see that it runs, and the same command goes on"
        ) from error
    except Exception as error:
        raise TaskError(f"{name} failed in a worker: {type(error).__name__}: {error}") from error


def finished_first(waiting: Iterable[Future], time_limit: float) -> set[Future]:
    """Those of some futures that are finished, as soon as there are any.

    It waits in slices, because a clock runs on while this process is suspended: one slice is lost, not all patience.

    Raises:
        TaskError: none was finished for `time_limit` seconds.
    """
    for _ in range(SLICES):
        done, _ = wait(waiting, time_limit / SLICES, return_when=FIRST_COMPLETED)
        if done:
            return done
    raise TaskError(
        f"nothing was heard of the workers for {time_limit:.0f} seconds: see whether they live"
    )


def run_in_order(
    executor: Executor, function: Callable, tasks: list[tuple], label: str | None = None
) -> list:
    """What every task returned, in the order of the tasks; with a progress bar if it has a label. As `run_tasks`."""
    finished = tqdm(
        run_tasks(executor, function, tasks),
        label,
        len(tasks),
        unit="episode",
        disable=label is None,
    )
    return [result for _, result in sorted(finished, key=operator.itemgetter(0))]


def refuse_in_starting_worker() -> None:
    """Raise RuntimeError in a worker that runs its parent's script again before it can do anything."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise RuntimeError(
            "a worker process reads your script from its first line, and so comes to this call again: put what the"
            ' script does below a line `if __name__ == "__main__":` (a notebook needs none)'
        )


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
    if (
        has_glibc()
        and int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        > above
    ):
        ctypes.CDLL(None).malloc_trim(0)


@functools.cache
def has_glibc() -> bool:
    """Whether this is Linux with the GNU C library."""
    return sys.platform == "linux" and platform.libc_ver()[0] == "glibc"


def peak_memory(executor: Executor | None = None) -> dict[str, float] | None:
    """The most memory, in MB, that this process and the largest process of an executor have held; None on Windows.

    On Linux the worker's is there only if there was one of this machine's, and includes what workers share (about
    170 MB); elsewhere it is that of the largest child process so far, git among them.
    """
    if sys.platform == "win32":
        return None
    worker = getattr(executor, "peak_memory", 0.0)
    if sys.platform == "linux":
        process = most_memory(os.getpid())
    else:
        import resource  # is not there on Windows

        unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kilobytes elsewhere
        process, worker = (
            resource.getrusage(who).ru_maxrss * unit / 1e6
            for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        )
    return {"process": round(process, 1)} | ({"worker": round(worker, 1)} if worker else {})


def most_memory(process: int) -> float:
    """The most memory in MB that a process of this number has held so far; 0 if it has ended, or not on Linux."""
    try:
        return (
            int(Path(f"/proc/{process}/status").read_text().split("VmHWM:")[1].split()[0])
            * 1024
            / 1e6
        )
    except (OSError, IndexError):
        return 0.0


def start_worker() -> None:
    """Prepare a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    work_alone()
    threading.Thread(target=end_with_parent, daemon=True).start()


def work_alone() -> None:
    """Compute on one thread from now on: the cores are kept busy by tasks, and last bits depend on the threads.

    Tasks call it, so that it holds for any executor's workers.
    """
    keep_freed_memory()
    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    cv2.setNumThreads(1)


def end_with_parent() -> None:
    """Wait until the parent process has ended, then end this one: a killed parent must not leave workers behind."""
    multiprocessing.parent_process().join()
    os._exit(1)
