"""Makes a run a shipped agent: `python -m stad_study ship`, for those who maintain stad_lab."""

from pathlib import Path

import torch

from stad_lab.agent import PRETRAINED
from stad_lab.io.files import copy_file, load_tensors, save_tensors
from stad_lab.io.weights import VAE_FILE, load_vae
from stad_lab.training.evolution import LOG
from stad_lab.training.pipeline import WEIGHTS
from stad_lab.training.record import RECORD


def ship(folder: str | Path, name: str) -> Path:
    """Copy a run into `stad_lab/pretrained/NAME`, as `copy_in_half` does; returns the new folder.

    Evaluate the shipped agent after this, not the run. ValueError for a wrong name, or if the run
    is the shipped agent itself; and as `copy_in_half`.
    """
    folder, target = Path(folder), PRETRAINED / name
    if target.resolve() == folder.resolve() or not name.isidentifier():
        expected = "a name of letters, digits and _, and the folder of a run"
        raise ValueError(f"name={name!r}, folder={folder}: expected {expected}")
    copy_in_half(folder, target)
    return target


def copy_in_half(folder: Path, target: Path) -> None:
    """Copy what an agent needs of a run: V and M in half precision, C, and its record.

    What an agent left in `target` is removed, but for its card. FileNotFoundError if the run has
    no V; ValueError if it is damaged.
    """
    load_vae(folder / VAE_FILE)
    shipped = [one for one in (*WEIGHTS, RECORD, LOG) if (folder / one).exists()]
    read = {one: load_tensors(folder / one) for one in shipped if one in WEIGHTS}  # all, then write
    for one, (tensors, metadata) in read.items():
        for key, value in tensors.items():
            tensors[key] = value.half() if value.dtype == torch.float32 else value
        save_tensors(target / one, tensors, **metadata)
    for one in sorted(set(shipped) - read.keys()):
        copy_file(folder / one, target)
    for file in target.glob("*.*"):
        if file.is_file() and file.name not in shipped and file.suffix != ".md":
            file.unlink()
