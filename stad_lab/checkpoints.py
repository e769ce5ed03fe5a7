"""Files that survive: atomic writes and checked reads, shared by V, M and C.

Weights are safetensors, everything else is JSON; nothing that is read can run code. A file is written under another
name, flushed to the disk and then renamed, so a reader sees the old version or the new one, never half of one.
"""

import hashlib
import json
import os
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

KIND = "stad_lab"


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that a crash at any moment leaves the old version or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def checksum(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def save_json(path: Path, value) -> None:
    """Write `value` as JSON, atomically."""
    write_bytes(path, (json.dumps(value, indent=1) + "\n").encode())


def load_json(path: Path, remedy: str = "make it again"):
    """Read a JSON file.

    Raises:
        FileNotFoundError: no such file; the message carries the remedy.
        ValueError: the file is damaged.
    """
    require_file(path, remedy)
    try:
        return json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is damaged ({error}): delete it and {remedy}") from error


def require_file(path: Path, remedy: str) -> None:
    """Raise FileNotFoundError, naming the remedy, unless the file exists."""
    if not path.is_file():
        where = "" if path.parent.is_dir() else f" (there is no folder {path.parent})"
        raise FileNotFoundError(f"{path} does not exist{where}: {remedy}")


def save_tensors(path: Path, tensors: dict[str, torch.Tensor], **facts) -> None:
    """Write tensors as safetensors, atomically, with `facts` (anything JSON can say) in the file's header."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_bytes(path, save(tensors, metadata={KIND: json.dumps(facts)}))


def load_tensors(path: Path, remedy: str = "make it again") -> tuple[dict[str, torch.Tensor], dict]:
    """Read what `save_tensors` wrote: (tensors, facts).

    Raises:
        FileNotFoundError: no such file; the message carries the remedy.
        ValueError: the file is damaged, or was not written by stad_lab.
    """
    require_file(path, remedy)
    try:
        with safe_open(path, framework="pt") as file:
            facts = json.loads((file.metadata() or {}).get(KIND, "null"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is damaged ({error}): delete it and {remedy}") from error
    if facts is None:
        raise ValueError(f"{path} was not written by stad_lab: give a file that `python -m stad_lab train` made")
    return tensors, facts


def load_into(module: torch.nn.Module, tensors: dict[str, torch.Tensor], path: Path) -> None:
    """Put tensors into a module; nothing is changed unless every name, shape and value fits.

    Raises:
        ValueError: names or shapes that differ, or weights that are not finite.
    """
    expected = module.state_dict()
    for name in expected.keys() | tensors.keys():
        if name not in tensors or name not in expected or tensors[name].shape != expected[name].shape:
            found = tuple(tensors[name].shape) if name in tensors else "nothing"
            wanted = tuple(expected[name].shape) if name in expected else "nothing"
            raise ValueError(
                f"{path} holds {found} for {name!r} where {type(module).__name__} with these settings has {wanted}:"
                " the weights belong to another variant or size"
            )
        if not torch.isfinite(tensors[name]).all():
            raise ValueError(f"{path} holds values that are not finite in {name!r}: train this part again")
    module.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
