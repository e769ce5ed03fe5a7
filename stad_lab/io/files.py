"""Files that survive: atomic, durable writes, reads that notice every changed bit, and one owner for a folder.

Weights are safetensors, everything else is JSON; nothing that is read can run code. A file is written under another
name, flushed to the disk and then renamed, so a reader sees the old version or the new one, never half of one. Every
file carries a checksum of what it says, and is not used if that has changed.
"""

import errno
import hashlib
import json
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import torch
from filelock import FileLock, Timeout
from safetensors.torch import load, save

KIND = "stad_lab"
CHECKSUM = "checksum"
PATIENCE = (
    1.0 if os.name == "nt" else 0.0
)  # seconds: on Windows a virus scanner may hold a file for a moment


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Own a folder for a `with` block; makes it if it is missing, and clears away what a killed process left half-done.

    The operating system frees the lock when the process ends, however it ends. A process may lock a folder repeatedly.

    Raises:
        OSError: another process works in the folder, or nobody may write there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / ".lock", timeout=0, is_singleton=True)
        lock.acquire()
    except Timeout:
        raise BlockingIOError(
            f"{folder} is in use by another process: wait until that has ended, or choose another folder"
        ) from None
    except OSError as error:
        raise OSError(
            f"{folder} is no folder to write to ({error.strerror}): choose another one"
        ) from error
    try:
        for file in folder.glob(".*.part"):
            if (ours := re.fullmatch(r"\..+\.(\d+)\.part", file.name)) and not psutil.pid_exists(
                int(ours[1])
            ):
                file.unlink(missing_ok=True)
        yield
    finally:
        lock.release()


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that a crash or a power cut at any moment leaves the old version or the new one.

    Raises:
        OSError: the disk is full or not to be written; the old version is still there.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def replace(temporary: Path, path: Path) -> None:
    """Rename a file to the name of another one; PermissionError if PATIENCE does not help."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            temporary.replace(path)
            return
        except PermissionError:
            if time.monotonic() >= deadline:
                raise
        time.sleep(0.02)


def unwritable(path: Path, error: OSError) -> OSError:
    """The error for a file that the system does not let us write."""
    return OSError(
        f"{path} could not be written ({error.strerror}): see to free room and to the right to write there; what was in"
        " it before is unchanged"
    )


def sync_folder(folder: Path) -> None:
    """Make a rename in the folder last through a power cut, where the system can (not on Windows and some shares)."""
    if os.name != "nt":
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):
                raise
        finally:
            os.close(opened)


def check_writable(path: Path) -> None:
    """Raise OSError, before any work, if the file `path` could not be written at its end."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: give the name of a file")
    if (
        path.exists() and not path.is_file()
    ):  # a device, which a file would take the place of for everybody
        raise OSError(f"{path} is no ordinary file: give the name of a file")
    trial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        trial.touch()
        trial.unlink()
    except OSError as error:
        raise unwritable(path, error) from error


def read_bytes(path: Path, remedy: str) -> bytes:
    """Read a file.

    Raises:
        FileNotFoundError: no such file; the message carries the remedy.
        OSError: there is something, but it cannot be read.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError:
        where = "" if path.parent.is_dir() else f" (there is no folder {path.parent})"
        raise FileNotFoundError(f"{path} does not exist{where}: {remedy}") from None
    except OSError as error:
        raise OSError(
            f"{path} cannot be read ({error.strerror}): make it readable, or move it away and {remedy}"
        ) from error


def copy_file(source: Path, folder: Path) -> None:
    """Copy a file into a folder under its own name, so that a kill at any moment leaves all of it or nothing.

    Raises:
        OSError: it cannot be read or written.
    """
    write_bytes(folder / source.name, read_bytes(source, "make it again"))


def checksum(content: bytes) -> str:
    """SHA-256 of some bytes, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def save_json(path: Path, value: dict) -> None:
    """Write a dict as JSON, atomically, with a checksum of the rest as its last entry.

    Each entry has a line, and so has each element of a list of dicts.
    """
    value = {name: part for name, part in value.items() if name != CHECKSUM}
    lines = [
        f"{json.dumps(name)}: {layout(part)}"
        for name, part in (value | {CHECKSUM: checksum_of_json(value)}).items()
    ]
    write_bytes(path, ("{\n" + ",\n".join(lines) + "\n}\n").encode())


def layout(part: Any) -> str:
    """One entry of a file as JSON."""
    if isinstance(part, list) and part and isinstance(part[0], dict):
        return "[\n" + ",\n".join(f" {json.dumps(element)}" for element in part) + "\n]"
    return json.dumps(part)


def checksum_of_json(value: Any) -> str:
    """SHA-256 of what JSON says, whatever its spaces and line ends."""
    return checksum(json.dumps(json.loads(json.dumps(value))).encode())


def load_json(path: Path, remedy: str = "make it again") -> dict:
    """Read what `save_json` wrote.

    Raises:
        FileNotFoundError: no such file; the message carries the remedy.
        OSError: it cannot be read.
        ValueError: the file is damaged, or was changed by hand.
    """
    content = read_bytes(path, remedy)
    try:
        value = json.loads(content)
        wanted = value.pop(CHECKSUM)
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        raise damaged(path, f"{type(error).__name__}: {error}", remedy) from error
    if checksum_of_json(value) != wanted:
        raise damaged(path, "it does not say what its checksum was made of", remedy)
    return value


def damaged(path: Path, reason: str, remedy: str) -> ValueError:
    """The error for a file that is not as it was written."""
    return ValueError(f"{path} is damaged ({reason}): delete it and {remedy}")


def save_tensors(path: Path, tensors: dict[str, torch.Tensor], **metadata) -> None:
    """Write tensors as safetensors, atomically, with `metadata` (anything JSON can say) and a checksum in its header."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    # In one entry: safetensors writes several in any order, and the same content should be the same bytes.
    said = json.dumps(metadata | {CHECKSUM: checksum_of_tensors(tensors, json.dumps(metadata))})
    write_bytes(path, save(tensors, metadata={KIND: said}))


def checksum_of_tensors(tensors: dict[str, torch.Tensor], said: str = "") -> str:
    """SHA-256 of names, types, shapes and values of tensors, and of what else is said about them."""
    found = hashlib.sha256(said.encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        found.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        found.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()


def load_tensors(path: Path, remedy: str = "make it again") -> tuple[dict[str, torch.Tensor], dict]:
    """Read what `save_tensors` wrote: (tensors, metadata).

    Raises:
        FileNotFoundError: no such file; the message carries the remedy.
        OSError: it cannot be read.
        ValueError: the file is damaged, or was not written by stad_lab.
    """
    content = read_bytes(path, remedy)
    try:
        tensors = load(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        metadata = json.loads(header.get("__metadata__", {}).get(KIND, "null"))
    except Exception as error:  # the parser meets bytes of any kind, and has many ways to say so
        raise damaged(path, f"{type(error).__name__}: {error}", remedy) from error
    if not isinstance(metadata, dict):
        raise ValueError(
            f"{path} was not written by stad_lab: give a file that `python -m stad_lab train` made"
        )
    wanted = metadata.pop(CHECKSUM, None)
    if checksum_of_tensors(tensors, json.dumps(metadata)) != wanted:
        raise damaged(path, "it does not hold what its checksum was made of", remedy)
    return tensors, metadata


def load_into(module: torch.nn.Module, tensors: dict[str, torch.Tensor], path: Path) -> None:
    """Put tensors into a module; nothing is changed unless every name, shape and value fits.

    Raises:
        ValueError: names or shapes that differ, or weights that are not finite.
    """
    expected = module.state_dict()
    for name in sorted(expected.keys() | tensors.keys()):
        if (
            name not in tensors
            or name not in expected
            or tensors[name].shape != expected[name].shape
        ):
            found = tuple(tensors[name].shape) if name in tensors else "nothing"
            wanted = tuple(expected[name].shape) if name in expected else "nothing"
            raise ValueError(
                f"{path} holds {found} for {name!r} where {type(module).__name__} with these settings has {wanted}:"
                " the weights belong to another variant or size"
            )
        if not torch.isfinite(tensors[name]).all():
            raise ValueError(
                f"{path} holds values that are not finite in {name!r}: train this part again"
            )
    module.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
