"""What the C library does with freed memory, which decides a tenth of the time of a training."""

import contextlib
import ctypes
import functools

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # parameters of glibc's mallopt


def keep_freed_memory() -> None:
    """Let the C library keep what a training step frees, because the next one needs it again.

    Otherwise the system takes it back and clears it, a tenth of the time of a step. Only glibc,
    the C library of most Linux systems, can be told.
    """
    if library := c_library():
        library.mallopt(M_MMAP_MAX, 0)
        library.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def return_freed_memory() -> None:
    """Give freed memory back now and then: otherwise it fragments, and the process grows."""
    if library := c_library():
        library.malloc_trim(0)


@functools.cache
def c_library() -> ctypes.CDLL | None:
    """glibc, or None on a system with another C library."""
    with contextlib.suppress(OSError):
        return ctypes.CDLL("libc.so.6")
    return None
