"""The first process in a submission's namespaces: it hides files, and gives up all its rights.

`python -m stad_course.compete.isolate WORK HIDDEN ... -- COMMAND ...` starts as root of new
namespaces (`unshare`). It covers the hidden files and folders, makes all but the folder WORK
read-only, and becomes the command, which has no capability to undo any of this.
"""

import ctypes
import os
import sys
from pathlib import Path

READ_ONLY, BIND = 1, 4096  # of mount(2)
MOUNT_SETATTR, RECURSIVE, FROM_HERE = 442, 0x8000, -100  # Linux 5.12
# By exec the root of a namespace gets every capability back that is not taken from these sets.
WITHOUT_RIGHTS = ["setpriv", "--no-new-privs", "--inh-caps=-all", "--ambient-caps=-all"]
WITHOUT_RIGHTS += ["--bounding-set=-all"]


class Attributes(ctypes.Structure):
    """The `mount_attr` of mount_setattr(2)."""

    _fields_ = [(name, ctypes.c_uint64) for name in ("set", "clear", "propagation", "user")]


def call(function: str, *arguments) -> None:
    """Call a function of the C library. OSError if it fails."""
    library = ctypes.CDLL(None, use_errno=True)
    if getattr(library, function)(*arguments):
        number = ctypes.get_errno()
        raise OSError(number, f"{function} {arguments}: {os.strerror(number)}")


def cover(path: Path) -> None:
    """Put an empty folder over a folder, or an empty file over a file."""
    if path.is_dir():
        call("mount", b"none", bytes(path), b"tmpfs", 0, b"size=64k")
    elif path.exists():  # not if a folder above it was covered
        call("mount", b"/dev/null", bytes(path), None, BIND, None)


def change(path: Path, attributes: Attributes, how: int = 0) -> None:
    """Change attributes of a mount, or of all below it, without touching its others."""
    found = ctypes.byref(attributes), ctypes.sizeof(attributes)
    call("syscall", MOUNT_SETATTR, FROM_HERE, bytes(path), how, *found)


def main() -> None:
    """Hide, protect, and become the command."""
    end = sys.argv.index("--")
    work, *hidden = map(Path, sys.argv[1:end])
    os.chdir(work)  # it can be reached from here when the folders above it are covered
    for path in hidden:
        cover(path)
    work.mkdir(parents=True, exist_ok=True)
    call("mount", b".", bytes(work), None, BIND, None)
    os.chdir(work)
    change(Path("/"), Attributes(set=READ_ONLY), RECURSIVE)
    change(work, Attributes(clear=READ_ONLY))
    os.execvp(WITHOUT_RIGHTS[0], [*WITHOUT_RIGHTS, *sys.argv[end + 1 :]])


if __name__ == "__main__":
    main()
