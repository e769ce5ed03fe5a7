"""Safe files: atomic writes, reads that notice every changed bit, and locked folders.

Weights are safetensors, everything else is JSON; nothing that is read can run code. A file is
written under another name, flushed to the disk and then renamed, so that a reader sees the old
version or the new one. Every file carries a checksum of its content.
"""

import errno
import hashlib
import json
import os
import re
import secrets
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from filelock import FileLock, Timeout
from safetensors.torch import load, save

from stad_lab.io.kinds import SHAPES, find_fault

METADATA = "stad_lab"  # the entry of a safetensors header that holds our metadata
CHECKSUM = "checksum"
PATIENCE = 1.0 if os.name == "nt" else 0.0  # seconds that a virus scanner may hold a file


@contextmanager
def locked(folder: Path, wait: float = 0.0) -> Iterator[None]:
    """Own a folder for a `with` block; it is made if missing, and cleared of half-written files.

    The operating system frees the lock when the process ends. A process may lock it repeatedly.
    OSError if another process works in the folder for `wait` seconds, or it cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / ".lock", timeout=0, is_singleton=True)
        lock.acquire(wait)
    except Timeout:
        message = f"{folder} is in use by another process: wait for it, or choose another folder"
        raise BlockingIOError(message) from None
    except OSError as error:
        message = f"cannot write to folder {folder} ({error.strerror}): choose another one"
        raise OSError(message) from error
    try:
        for file in folder.glob(".*.part"):
            ours = re.search(r"\.(\d+)\.[^.]*\.part$", file.name)
            if ours and is_left_over(file, int(ours[1])):
                file.unlink(missing_ok=True)
        yield
    finally:
        lock.release()


def is_left_over(file: Path, process: int) -> bool:
    """Whether a file was begun by a process that has ended, though another may have its number.

    In a container every run is process 1.
    """
    try:
        return psutil.Process(process).create_time() > file.stat().st_mtime
    except (psutil.NoSuchProcess, FileNotFoundError):
        return True
    except psutil.Error:  # of another user
        return False


def write_bytes(path: Path, content: bytes | memoryview) -> None:
    """Write a file so that a crash, or an OSError, leaves the old version or the new one."""
    # A random name, opened exclusively: nobody can have put a link there.
    temporary = path.with_name(f".{os.getpid()}.{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as file:
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
    """Rename a file over another one; PermissionError if that is still refused after PATIENCE."""
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
    """The error for a file that cannot be written."""
    return OSError(
        f"{path} could not be written ({error.strerror}): check the free space and the right to"
        " write there; what was in it before is unchanged"
    )


def sync_folder(folder: Path) -> None:
    """Make a rename survive a power cut, where the system can (not on Windows)."""
    if os.name != "nt":
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # as on some network shares
                raise
        finally:
            os.close(opened)


def check_writable(path: Path) -> None:
    """Raise OSError, before any work, if the file `path` could not be written at its end."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: give the name of a file")
    if path.exists() and not path.is_file():  # a device, for example
        raise OSError(f"{path} is no ordinary file: give the name of a file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise unwritable(path, error) from error


def read_bytes(path: Path, remedy: str) -> bytes:
    """Read a file. The message of a FileNotFoundError, or of another OSError, has the remedy."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        where = "" if path.parent.is_dir() else f" (there is no folder {path.parent})"
        raise FileNotFoundError(f"{path} does not exist{where}: {remedy}") from None
    except OSError as error:
        remedy = f"make it readable, or move it away and {remedy}"
        raise OSError(f"{path} cannot be read ({error.strerror}): {remedy}") from error


def copy_file(source: Path, folder: Path) -> None:
    """Copy a file into a folder under its own name, atomically."""
    write_bytes(folder / source.name, read_bytes(source, "make it again"))


def checksum(content: bytes | memoryview) -> str:
    """SHA-256 of some bytes, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def save_json(path: Path, value: dict) -> None:
    """Write a dict as JSON, atomically, with a checksum of the rest as its last entry."""
    value = {name: part for name, part in value.items() if name != CHECKSUM}
    whole = value | {CHECKSUM: checksum_of_json(value)}
    lines = [f"{json.dumps(name)}: {layout(part)}" for name, part in whole.items()]
    write_bytes(path, ("{\n" + ",\n".join(lines) + "\n}\n").encode())


def layout(part: Any) -> str:
    """One entry of a file as JSON: a line, or a line for each element of a list of dicts."""
    if isinstance(part, list) and part and isinstance(part[0], dict):
        return "[\n" + ",\n".join(f" {json.dumps(element)}" for element in part) + "\n]"
    return json.dumps(part)


def checksum_of_json(value: Any) -> str:
    """SHA-256 of what JSON says, whatever its spaces and line ends."""
    return checksum(json.dumps(json.loads(json.dumps(value))).encode())


def load_json(path: Path, remedy: str = "make it again", kind: str | None = None) -> dict:
    """Read what `save_json` wrote.

    Args:
        remedy: what the message of an error advises.
        kind: that the file must be of; None for any.

    Raises:
        OSError: as `read_bytes`.
        ValueError: the file is damaged, was changed by hand, names another kind as its own, or
            lacks what a file of its kind holds.
    """
    content = read_bytes(path, remedy)
    try:
        value = json.loads(content, object_pairs_hook=without_duplicates)
        wanted = value.pop(CHECKSUM)
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        raise damaged(path, f"{type(error).__name__}: {error}", remedy) from error
    if checksum_of_json(value) != wanted:
        raise damaged(path, "its content is not that of its checksum", remedy)
    if kind and value.get("kind", kind) != kind:
        raise ValueError(f"{path} is of kind {value['kind']!r}: expected {kind!r}")
    check_kind(path, value, value.get("kind", kind), remedy)
    return value


def check_kind(path: Path, value: dict, kind: Any, remedy: str) -> None:
    """Raise ValueError unless the content of a file has the shape of its kind, if that is known."""
    shape = SHAPES.get(kind) if isinstance(kind, str) else None
    if shape and (fault := find_fault(value, shape)):
        raise ValueError(f"{path} is not a file of the kind {kind!r}: {fault}; {remedy}")


def without_duplicates(pairs: list[tuple[str, Any]]) -> dict:
    """The dict of some pairs; ValueError if a key is there twice, since one would be ignored."""
    value = dict(pairs)
    if len(value) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"{next(key for key in keys if keys.count(key) > 1)!r} is there twice")
    return value


def damaged(path: Path, reason: str, remedy: str) -> ValueError:
    """The error for a file that is not as it was written."""
    return ValueError(f"{path} is damaged ({reason}): delete it and {remedy}")


def save_tensors(path: Path, tensors: dict[str, torch.Tensor], **metadata) -> None:
    """Write tensors as safetensors, atomically, with metadata (JSON) and a checksum."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    # One entry: safetensors writes several in any order, and equal content should be equal bytes.
    found = checksum_of_tensors(tensors, json.dumps(metadata))
    said = json.dumps(metadata | {CHECKSUM: found})
    write_bytes(path, save(tensors, metadata={METADATA: said}))


def checksum_of_tensors(tensors: dict[str, torch.Tensor], said: str = "") -> str:
    """SHA-256 of names, types, shapes and values of tensors, and of their metadata."""
    found = hashlib.sha256(said.encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        found.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        found.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()


def checksum_of_arrays(**arrays: np.ndarray) -> str:
    """`checksum_of_tensors` of NumPy arrays."""
    return checksum_of_tensors({name: torch.from_numpy(array) for name, array in arrays.items()})


def load_tensors(path: Path, remedy: str = "make it again") -> tuple[dict[str, torch.Tensor], dict]:
    """Read what `save_tensors` wrote: (tensors, metadata).

    Raises:
        OSError: as `read_bytes`.
        ValueError: the file is damaged, or was not written by stad_lab.
    """
    content = read_bytes(path, remedy)
    try:
        tensors = load(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        metadata = json.loads(header.get("__metadata__", {}).get(METADATA, "null"))
    except Exception as error:  # the parser meets bytes of any kind, and raises many errors
        raise damaged(path, f"{type(error).__name__}: {error}", remedy) from error
    if not isinstance(metadata, dict):
        remedy = "give a file of `python -m stad_lab train`"
        raise ValueError(f"{path} was not written by stad_lab: {remedy}")
    wanted = metadata.pop(CHECKSUM, None)
    if checksum_of_tensors(tensors, json.dumps(metadata)) != wanted:
        raise damaged(path, "its content is not that of its checksum", remedy)
    check_kind(path, metadata, metadata.get("kind"), remedy)
    return tensors, metadata


def load_into(module: torch.nn.Module, tensors: dict[str, torch.Tensor], path: Path) -> None:
    """Put tensors into a module as float32; ValueError if a name, shape or value is wrong."""
    expected = module.state_dict()
    for name in sorted(expected.keys() | tensors.keys()):
        found, wanted = (
            tuple(part[name].shape) if name in part else "nothing" for part in (tensors, expected)
        )
        if found != wanted:
            raise ValueError(
                f"{path} holds {found} for {name!r}, {type(module).__name__} of these settings has"
                f" {wanted}: the weights belong to another variant or size"
            )
        if not torch.isfinite(tensors[name]).all():
            raise ValueError(f"{path} holds values that are not finite in {name!r}: train it again")
    module.float().load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
