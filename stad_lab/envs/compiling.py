"""Compiling with Numba: kept on disk wherever that is possible, and announced when it takes long.

Numba keeps compiled code beside the source, or in the user's cache if the package's folder is
read-only, or in NUMBA_CACHE_DIR. Files are replaced as a whole, so processes that compile at the
same time do no harm. Where none of these folders can be written, we take one for temporary files.
"""

import os
import sys
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numba
from numba.core import event

NOTICE = "compiling the engine, once: about 20 seconds"


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
            folder = tempfile.mkdtemp()  # who owns the folder could plant code
    except OSError:
        return
    numba.config.CACHE_DIR = str(folder)


class Announcement(event.Listener):
    """Prints one line to stderr when Numba begins to compile; loading from disk is no compiling."""

    printed = False

    def on_start(self, _: event.Event) -> None:
        """Numba begins to compile a function."""
        if not self.printed:
            self.printed = True
            print(NOTICE, file=sys.stderr, flush=True)

    def on_end(self, _: event.Event) -> None:
        """Numba has compiled a function."""


def announced() -> AbstractContextManager:
    """Announce what is compiled within a `with` block."""
    return event.install_listener("numba:compile", Announcement())
