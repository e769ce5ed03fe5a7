"""Compiling with Numba: kept on disk wherever that is possible, and announced when it takes long.

Numba keeps compiled code beside the source, or in the user's cache if the package's folder is
read-only, or in NUMBA_CACHE_DIR. Where none of these folders can be written, we take one for
temporary files. A process that finds another one compiling waits, and loads what that has compiled.
Numba compiles one function at a time, so the one that compiles starts a second process beside it.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numba
from filelock import BaseFileLock, FileLock, Timeout
from numba.core import event

NOTICE = "compiling the engine, once: about 20 seconds"
PATIENCE = 60.0  # seconds to wait for another process


def compiled(function: Callable | None = None, **options) -> Callable:
    """`numba.njit` without the GIL, with a cache if a folder for it can be written.

    Args:
        **options: further ones of `njit`. If there are any, it is used as `@compiled(...)`.
    """
    if function is None:
        return lambda function: compiled(function, **options)
    options |= {"nogil": True}
    for _ in range(2):
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # Numba found no folder that it can write
            use_temporary_folder()
    return numba.njit(**options)(function)


def use_temporary_folder() -> None:
    """Let Numba keep compiled code in a folder for temporary files that is this user's alone."""
    user = os.getuid() if hasattr(os, "getuid") else "user"
    folder = Path(tempfile.gettempdir()) / f"stad_lab-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        if folder.is_symlink() or (user != "user" and folder.stat().st_uid != user):
            folder = Path(tempfile.mkdtemp())  # who owns the folder could plant code
    except OSError:
        return
    numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]


class Announcement(event.Listener):
    """Prints one line to stderr when Numba begins to compile; loading from disk is no compiling.

    Args:
        beside: Python code that compiles, too; it is then started in another process.
    """

    def __init__(self, beside: str | None = None):
        self.printed, self.beside = False, beside
        self.process: subprocess.Popen | None = None
        self.lock: BaseFileLock | None = None

    def on_start(self, begun: event.Event) -> None:
        """Numba begins to compile a function."""
        if self.printed:
            return
        self.printed = True
        print(NOTICE, file=sys.stderr, flush=True)
        waited = self.has_waited(begun.data["dispatcher"].stats.cache_path)
        if self.beside and sys.executable and not waited:
            self.process = start_python(self.beside)

    def has_waited(self, folder: str | None) -> bool:
        """Wait while another process compiles into this folder; whether one did."""
        if not folder:  # nothing is kept
            return False
        self.lock = FileLock(Path(folder) / "compiling.lock", thread_local=False)
        try:
            self.lock.acquire(timeout=0)
        except Timeout:
            with suppress(Timeout):  # it takes too long: both compile
                self.lock.acquire(timeout=PATIENCE)
            return True
        except (OSError, NotImplementedError):  # a folder without locks: both compile
            pass
        return False

    def on_end(self, _: event.Event) -> None:
        """Numba has compiled a function."""

    def wait(self) -> None:
        """Wait for the other process. What it has not compiled is compiled here when needed."""
        if self.process:
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(PATIENCE)

    def release(self) -> None:
        """Let a process go on that waits for what this one compiles."""
        if self.lock:
            self.lock.release()


def start_python(code: str) -> subprocess.Popen:
    """Run code in another Python with the same modules and the same folder of compiled code."""
    same = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    if folder := getattr(numba.config, "CACHE_DIR", ""):
        same["NUMBA_CACHE_DIR"] = folder
    none = subprocess.DEVNULL
    command = [sys.executable, "-c", code]
    return subprocess.Popen(command, env=os.environ | same, stdin=none, stdout=none, stderr=none)


@contextmanager
def announced(beside: str | None = None) -> Iterator[Announcement]:
    """Announce what is compiled within a `with` block; `beside` as of `Announcement`."""
    announcement = Announcement(beside)
    with event.install_listener("numba:compile", announcement):
        try:
            yield announcement
        finally:
            announcement.release()
