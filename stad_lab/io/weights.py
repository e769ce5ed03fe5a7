"""The files of V, M and C: how they are written, read, and checked to belong together.

Each file's metadata says what it holds ("kind"), the configuration it was trained with, and the
checksums of what it depends on: M names its V, and C its V and M.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from stad_lab.config import RANGES, Config, check_same
from stad_lab.io.files import checksum_of_tensors, load_into, load_tensors, save_tensors
from stad_lab.models.controller import check_parameters
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE

VAE_FILE, MDN_RNN_FILE = "vae.safetensors", "mdn_rnn.safetensors"
CONTROLLER_FILE = "controller.safetensors"
REMEDY = "train it: python -m stad_lab train --help"


class WorldModel(NamedTuple):
    """V and M of one run, and how V's pictures are made."""

    vae: VAE
    mdn_rnn: MDNRNN
    stride: int  # k of the difference image, frames
    crop_bar: bool  # whether V sees frames without the indicator bar
    checksums: dict[str, str]  # of V ("vae") and M ("mdn_rnn"), by which C names them

    @property
    def sizes(self) -> tuple[int, int]:
        """How many numbers z and h have."""
        return self.vae.latent_size, self.mdn_rnn.hidden_size


def save_vae(
    path: Path, vae: VAE, config: Config, history: list | None = None, dataset: str | None = None
) -> None:
    """Write V with its configuration, its training history and the checksum of its dataset."""
    metadata = {"variant": vae.variant, "seed": config.seed, "vae": dataclasses.asdict(config.vae)}
    metadata |= {"crop_bar": config.data.crop_bar, "dataset": dataset, "history": history or []}
    weights = vae.state_dict()
    save_tensors(path, weights, kind="vae", weights=checksum_of_tensors(weights), **metadata)


@torch.random.fork_rng([])  # a new module draws weights, which are replaced
def load_vae(path: Path) -> tuple[VAE, dict]:
    """Read V: (the VAE in evaluation mode, its metadata).

    FileNotFoundError if there is no such file; ValueError if it is damaged, or not V.
    """
    tensors, metadata = load_kind(path, "vae", "variant", "vae", "crop_bar", "weights", "history")
    vae = VAE.of(config_of(path, metadata))
    load_into(vae.to(memory_format=torch.channels_last), tensors, path)  # type: ignore[call-overload]
    return vae.eval().requires_grad_(False), metadata


def save_mdn_rnn(
    path: Path, mdn_rnn: MDNRNN, config: Config, history: list | None = None, vae: str | None = None
) -> None:
    """Write M with its configuration, its training history and the checksum of its V."""
    metadata: dict[str, Any] = {"variant": config.variant, "seed": config.seed}
    metadata |= {"latent_size": mdn_rnn.latent_size}
    settings, weights = dataclasses.asdict(config.mdn_rnn), mdn_rnn.state_dict()
    metadata |= {"mdn_rnn": settings, "vae": vae, "history": history or []}
    save_tensors(path, weights, kind="mdn_rnn", weights=checksum_of_tensors(weights), **metadata)


@torch.random.fork_rng([])
def load_mdn_rnn(path: Path) -> tuple[MDNRNN, dict]:
    """Read M: (the MDN-RNN in evaluation mode, its metadata). Raises as `load_vae`."""
    tensors, metadata = load_kind(path, "mdn_rnn", "latent_size", "mdn_rnn", "vae", "weights")
    sizes = {"vae": {"latent_size": metadata["latent_size"]}, "mdn_rnn": metadata["mdn_rnn"]}
    mdn_rnn = MDNRNN.of(config_of(path, sizes))
    load_into(mdn_rnn, tensors, path)
    return mdn_rnn.eval().requires_grad_(False), metadata


def save_controller(path: Path, parameters: np.ndarray, **metadata) -> None:
    """Write C's parameters, float64 (parameters,), with where they come from.

    `load_controller` needs "variant", and the checksums "vae" and "mdn_rnn", in the metadata.
    """
    tensors = {"parameters": torch.from_numpy(parameters)}
    save_tensors(path, tensors, kind="controller", **metadata)


def load_controller(path: Path) -> tuple[np.ndarray, dict]:
    """Read C: (its parameters, float64 (parameters,), and its metadata). Raises as `load_vae`."""
    tensors, metadata = load_kind(path, "controller", "variant", "vae", "mdn_rnn")
    if "parameters" not in tensors:
        raise ValueError(f"{path} is not a file of this kind: it has no parameters; {REMEDY}")
    parameters = tensors["parameters"].double().numpy()
    check_parameters(parameters, parameters.shape[-1], path)
    return parameters, metadata


def load_kind(path: Path, kind: str, *required: str) -> tuple[dict[str, torch.Tensor], dict]:
    """Read a file of this kind, with these entries of metadata. Raises as `load_vae`."""
    tensors, metadata = load_tensors(path, REMEDY)
    if "part" in metadata:
        raise ValueError(f"{path} was written by stad_lab 0.1: use that version, or train again")
    if metadata.get("kind") != kind:
        raise ValueError(f"{path} holds {metadata.get('kind')!r}: expected a file of {kind!r}")
    if missing := [name for name in required if name not in metadata]:
        raise ValueError(f"{path} is not a file of this kind: it lacks {missing[0]!r}; {REMEDY}")
    return tensors, metadata


def load_training(path: Path, made_with: dict) -> tuple[dict[str, torch.Tensor], dict]:
    """Read a half-trained V or M; ValueError if damaged, or made with something else."""
    tensors, metadata = load_tensors(path, "run the same command again to train from the start")
    check_same(path, metadata.get("made_with", {}), made_with)
    return tensors, metadata


def config_of(path: Path, metadata: dict) -> Config:
    """The part of a run's configuration that a file names. ValueError if it is not a valid one."""
    named = {name: metadata[name] for name in ("variant", "vae", "mdn_rnn") if name in metadata}
    longest = RANGES["data.episode_frames"][1]  # into which every stride and sequence fits
    try:
        return Config.from_dict({"data": {"episode_frames": longest}, **named})
    except ValueError as error:
        raise ValueError(f"{path} is not a file of this kind: {error}; {REMEDY}") from error


def check_belongs(path: Path, metadata: dict, **checksums: str) -> None:
    """Raise ValueError unless a file names the V (and M) of these checksums as its own."""
    for part, checksum in checksums.items():
        if metadata.get(part) != checksum:
            message = f"{path} was made with another {part} than the one beside it"
            raise ValueError(f"{message}: give V, M and C of one run")


def load_world_model(folder: Path) -> WorldModel:
    """V and M of a run; read again only when the files have changed.

    FileNotFoundError if one is missing; ValueError if one is damaged, or of another run.
    """
    files = [Path(folder) / name for name in (VAE_FILE, MDN_RNN_FILE)]
    times = tuple(file.stat().st_mtime_ns if file.exists() else 0 for file in files)
    return read_world_model(Path(folder), times)


@functools.lru_cache(maxsize=2)
def read_world_model(folder: Path, times: tuple[int, int]) -> WorldModel:
    """`load_world_model`, kept for files with the same modification times."""
    vae, v_metadata = load_vae(folder / VAE_FILE)
    mdn_rnn, m_metadata = load_mdn_rnn(folder / MDN_RNN_FILE)
    check_belongs(folder / MDN_RNN_FILE, m_metadata, vae=v_metadata["weights"])
    checksums = {"vae": v_metadata["weights"], "mdn_rnn": m_metadata["weights"]}
    stride, crop_bar = v_metadata["vae"]["stride"], v_metadata["crop_bar"]
    return WorldModel(vae, mdn_rnn, stride, crop_bar, checksums)
