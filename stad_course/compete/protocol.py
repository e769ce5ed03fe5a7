"""Messages between parent and child: one line of JSON, and the bytes of an array after it.

The parent asks "reset" (with the number of cars), "keep" (their numbers) or "act" (with pictures).
The child answers "ready", "actions" (with float64 (cars, 3)) or "error" (with one line).
"""

import json
from typing import IO

import numpy as np

LONGEST_LINE = 10_000  # bytes
LARGEST_ARRAY = 100_000_000  # bytes


def send(stream: IO[bytes], kind: str, array: np.ndarray | None = None, **fields) -> None:
    """Write one message."""
    size = 0 if array is None else array.nbytes
    shape = None if array is None else array.shape
    stream.write(json.dumps({"kind": kind, "shape": shape, "size": size, **fields}).encode())
    stream.write(b"\n")
    if size:
        stream.write(np.ascontiguousarray(array).data)
    stream.flush()


def receive(stream: IO[bytes], dtype: type, most: int = LARGEST_ARRAY) -> tuple[dict, np.ndarray]:
    """Read one message: its fields, and its array of this dtype (of size 0 if it has none).

    EOFError if the other process has ended. ValueError for what is no message, or for an array of
    more than `most` bytes: the child is not trusted.
    """
    line = stream.readline(LONGEST_LINE)
    if not line:
        raise EOFError
    fields = json.loads(line)
    if not isinstance(fields, dict) or not isinstance(fields.get("size"), int):
        raise ValueError("no message of the protocol")
    if not 0 <= fields["size"] <= most:
        raise ValueError(f"an array of {fields['size']} bytes: expected at most {most}")
    content = stream.read(fields["size"])
    if len(content) < fields["size"]:
        raise EOFError
    array: np.ndarray = np.frombuffer(content, dtype)
    return fields, array.reshape(fields["shape"]) if fields["size"] else array
