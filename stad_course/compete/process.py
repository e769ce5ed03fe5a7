"""The parent's end of a submission's process: limits, isolation, and what went wrong in one line.

On Linux with user namespaces the process has no network, sees no process but its own, cannot write
outside its folder, and cannot see the hidden tracks or other submissions (`isolate`). Elsewhere it
has the rights of whoever runs the competition.
"""

import contextlib
import functools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import psutil

import stad_lab
from stad_course.compete.child import AGENT_FILE, PROCESSES
from stad_course.compete.limits import Limits
from stad_course.compete.protocol import receive, send

MAKING = threading.Lock()
PAUSE = 0.05  # seconds between two looks of the watchdog
LARGEST_SUBMISSION = 300_000_000  # bytes
DATASET = "dataset"  # the folder of a trained run that its agent does not need
LOWEST, HIGHEST = (-1.0, 0.0, 0.0), (1.0, 1.0, 1.0)  # steering, gas and brake
UNSHARE = ["unshare", "--user", "--map-root-user", "--net", "--ipc", "--mount", "--pid", "--fork"]
UNSHARE += ["--kill-child", "--mount-proc"]
PACKAGE = Path(stad_lab.__file__).resolve().parent


class Failure(Exception):
    """A submission broke a rule or broke down; the message is one line for its author."""


@functools.cache
def can_isolate() -> bool:
    """Whether this system lets us start processes in namespaces of their own."""
    if sys.platform != "linux" or not all(map(shutil.which, ("unshare", "setpriv"))):
        return False
    with tempfile.TemporaryDirectory() as work:
        command = isolated(Path(work), (), ["true"])
        return subprocess.run(command, capture_output=True, env=environment(work)).returncode == 0


def isolated(work: Path, hidden: tuple[Path, ...], command: list[str]) -> list[str]:
    """A command that runs another one in namespaces of its own; see `isolate`."""
    covered = [str(one.resolve()) for one in hidden if one.exists()]
    isolate = [sys.executable, "-P", "-m", "stad_course.compete.isolate", str(work), *covered]
    return [*UNSHARE, *isolate, "--", *command]


def environment(home: str | Path) -> dict[str, str]:
    """The variables of a submission's process, whose files lie in a folder."""
    kept = ("PATH", "LANG", "SYSTEMROOT", "NUMBA_CACHE_DIR", "LD_LIBRARY_PATH")
    return {name: os.environ[name] for name in kept if name in os.environ} | {
        "PYTHONPATH": str(PACKAGE.parent),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONIOENCODING": "utf-8",
        "OMP_NUM_THREADS": "1",
        "CUDA_VISIBLE_DEVICES": "",
        **dict.fromkeys(("HOME", "TMPDIR", "MPLCONFIGDIR"), str(home)),
    }


@functools.cache
def temporary_folder() -> tempfile.TemporaryDirectory:
    """A folder that lasts as long as this process."""
    return tempfile.TemporaryDirectory(prefix="stad_lab-")


def shared_folder() -> str:
    """In which the folders of all submissions lie: each sees its own."""
    with MAKING:  # of two that two threads make, one would be removed at once
        return temporary_folder().name


class Submission:
    """A submission's process, as a `Driver` for `rollout`; use it in a `with` block.

    Its methods raise Failure, after which the process has been killed.

    Args:
        path: a file or a folder, of which the process gets a copy.
        limits: what it may use.
        used: seconds that it has used before.
        hidden: files and folders that it must not see.

    Attributes:
        used: seconds that it has used.
    """

    def __init__(
        self, path: Path, limits: Limits, used: float = 0.0, hidden: tuple[Path, ...] = ()
    ):
        self.limits, self.used, self.hidden = limits, used, hidden
        self.deadline, self.bound = float("inf"), ""  # of the answer that is awaited
        self.broken, self.fresh = "", True
        self.folder = Path(tempfile.mkdtemp(dir=shared_folder())).resolve()
        try:
            self.process = self._start(copied(path, self.folder))
            threading.Thread(target=self._watch, daemon=True).start()
            self._ask(self.limits.start)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "Submission":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def reset(self) -> None:
        """Begin new episodes, with as many cars as the first `act_batch` shows."""
        self.begins = True

    def act_batch(self, seen: np.ndarray) -> np.ndarray:
        """Actions float64 (cars, 3), clipped to their ranges, for observations of the cars."""
        count = len(seen)
        if self.begins:
            self._ask(self.limits.start, "reset", cars=count)
            self.begins = False
        seconds = self.limits.start if self.fresh else self.limits.step * count
        actions = self._ask(seconds, "act", seen)
        self.fresh = False
        if actions.shape != (count, 3) or not np.isfinite(actions).all():
            raise self._failed("its answer is not three finite numbers for each car")
        return np.clip(actions, LOWEST, HIGHEST)

    def keep(self, cars: np.ndarray) -> None:
        """Continue with some of the present cars."""
        self._ask(self.limits.start, "keep", cars=cars.tolist())

    def close(self) -> None:
        """End the process, with all that it started."""
        if process := getattr(self, "process", None):
            self._kill()
            for stream in (process.stdin, process.stdout):
                with contextlib.suppress(OSError):
                    stream.close()
            process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _start(self, path: Path) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-P", "-m", "stad_course.compete.child", str(path)]
        command.append(str(round(self.limits.memory * 1e9)))
        variables = environment(self.folder)
        if can_isolate():
            command = isolated(self.folder, (self.folder.parent, *self.hidden), command)
            variables["STAD_LAB_ISOLATED"] = "1"
        return subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=self.folder,
            env=variables,
            start_new_session=os.name != "nt",
        )

    def _ask(self, seconds: float, kind: str = "", array=None, **fields) -> np.ndarray:
        """Send a message, if there is one, and return the array of the answer."""
        stdin, stdout = self.process.stdin, self.process.stdout
        assert stdin is not None and stdout is not None  # pipes
        begin = time.monotonic()
        begins = kind != "act" or self.fresh
        self.bound = f"{seconds:g} s to begin" if begins else f"{self.limits.step:g} s"
        if kind and (left := self.limits.total - self.used) < seconds:
            seconds, self.bound = left, f"{self.limits.total:g} s in all"
        self.deadline = begin + seconds
        try:
            if kind:
                send(stdin, kind, array, **fields)
            most = 0 if array is None else len(array) * 3 * 8
            answer, actions = receive(stdout, np.float64, most)
        except (EOFError, OSError):
            raise self._failed(self._ending()) from None
        except (ValueError, TypeError, KeyError, RecursionError):
            raise self._failed("it wrote into the pipe of its answers") from None
        finally:
            self.deadline = float("inf")
            if kind:  # all but loading
                self.used += time.monotonic() - begin
        if answer.get("kind") == "error":
            text = filter(str.isprintable, str(answer.get("text"))[:500])  # it may be shown raw
            raise self._failed(self.broken or "".join(text))
        return actions

    def _failed(self, reason: str) -> Failure:
        self._kill()
        return Failure(reason)

    def _ending(self) -> str:
        """Why the process has ended."""
        if self.broken:
            return self.broken
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(2)
        status = self.process.returncode
        if status is not None and status < 0:
            named = {number.value: number.name for number in signal.Signals}
            return f"its process was ended by {named.get(-status, f'signal {-status}')}"
        return f"its process ended by itself (exit status {status})"

    def _watch(self) -> None:
        """Kill the process when it takes too long or too much, until it ends."""
        while self.process.poll() is None:
            if time.monotonic() > self.deadline:
                self.broken = f"it took longer than the limit of {self.bound}"
            else:
                self.broken = self._excess()
            if self.broken:
                break
            time.sleep(PAUSE)
        self._kill()  # what it started may hold the pipe of its answers

    def _excess(self) -> str:
        """What the process and its descendants take too much of; empty if nothing."""
        with contextlib.suppress(psutil.Error):
            family = psutil.Process(self.process.pid)
            family = [family, *family.children(recursive=True)]
            if len(family) > PROCESSES:
                return f"it started more than {PROCESSES} processes"
            used = 0
            for one in family:
                with contextlib.suppress(psutil.Error):
                    used += one.memory_info().rss
            if used > self.limits.memory * 1e9:
                return f"it needs more memory than the limit of {self.limits.memory:g} GB"
        return ""

    def _kill(self) -> None:
        family = []
        with contextlib.suppress(psutil.Error):
            family = psutil.Process(self.process.pid).children(recursive=True)
        with contextlib.suppress(OSError):
            self.process.kill()
            if os.name != "nt":
                os.killpg(self.process.pid, signal.SIGKILL)
        for one in family:
            with contextlib.suppress(psutil.Error):
                one.kill()


def copied(path: Path, folder: Path) -> Path:
    """A copy of a submission in a folder, without a run's dataset. Failure if it is too large."""
    target = folder / path.resolve().name
    if (size := size_of(path)) > LARGEST_SUBMISSION:
        raise Failure(
            f"it has {size / 1e6:.0f} MB, at most {LARGEST_SUBMISSION / 1e6:.0f} are read"
        )
    if path.is_file():
        return Path(shutil.copyfile(path, target))

    def left_out(parent: str, _: list[str]) -> list[str]:
        return [DATASET] if is_run(path) and Path(parent) == path else []

    return Path(shutil.copytree(path, target, symlinks=True, ignore=left_out))


def size_of(path: Path) -> int:
    """The size of a submission's files, bytes; a link within a folder is not followed."""
    return sum((one.stat() if one == path else one.lstat()).st_size for one in files_of(path))


def is_run(path: Path) -> bool:
    """Whether a submission is the folder of a trained run."""
    return path.is_dir() and not (path / AGENT_FILE).exists()


def files_of(path: Path) -> list[Path]:
    """The files of a submission, without a run's dataset, which has gigabytes."""
    if path.is_file():
        return [path]
    files = [one for one in path.rglob("*") if one.is_file()]
    left_out = path / DATASET
    return [one for one in files if not (is_run(path) and one.is_relative_to(left_out))]
