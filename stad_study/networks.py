"""The trained agents of a study, kept in half precision: what driving needs of V, M and C.

In the folder of a study::

    seed0/frame/world_model.safetensors   V's encoder and M's LSTM
    seed0/frame/z.safetensors             C that sees z
    seed0/frame/z_h.safetensors           C that sees z and h

The numbers are stored in 16 bits and computed with in 32. What a study reports was driven with
them, so that anyone can drive it again.
"""

import dataclasses
from pathlib import Path

import numpy as np
import torch

from stad_lab.agent import Agent
from stad_lab.config import Config
from stad_lab.io.files import load_into, save_tensors
from stad_lab.io.weights import (
    WorldModel,
    check_belongs,
    config_of,
    load_controller,
    load_kind,
    load_world_model,
    save_controller,
)
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE

NETWORKS = Path(__file__).parent / "networks"  # in the repository, not in what pip installs
WORLD_MODEL_FILE = "world_model.safetensors"
KIND = "driving world model"
DRIVES = {"vae": "encoder.", "mdn_rnn": "lstm."}  # the part of each network that driving needs


def keep_world_model(config: Config, run: Path, path: Path) -> None:
    """Write V's encoder and M's LSTM of a run in half precision, float16."""
    world_model, tensors = load_world_model(run), {}
    for network, part in DRIVES.items():
        for name, value in getattr(world_model, network).state_dict().items():
            if name.startswith(part):
                tensors[f"{network}.{name}"] = value.half()
    settings = {network: dataclasses.asdict(getattr(config, network)) for network in DRIVES}
    metadata = {"variant": config.variant, "seed": config.seed, **settings}
    metadata |= {"crop_bar": world_model.crop_bar, "trained": world_model.checksums}
    save_tensors(path, tensors, kind=KIND, **metadata)


@torch.random.fork_rng([])  # a new module draws weights, which are replaced
def load_kept_world_model(path: Path) -> WorldModel:
    """Read what `keep_world_model` wrote: a V without decoder and an M without mixture, float32.

    FileNotFoundError if there is no such file; ValueError if it is damaged, or of another kind.
    """
    tensors, metadata = load_kind(path, KIND, "variant", "vae", "mdn_rnn", "crop_bar", "trained")
    config = config_of(path, metadata)
    vae, mdn_rnn = VAE.of(config), MDNRNN.of(config)
    del vae.decoder, mdn_rnn.head
    vae = vae.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    for name, network in (("vae.", vae), ("mdn_rnn.", mdn_rnn)):
        own = {key.removeprefix(name): one for key, one in tensors.items() if key.startswith(name)}
        load_into(network, own, path)
        network.eval().requires_grad_(False)
    return WorldModel(vae, mdn_rnn, config.vae.stride, metadata["crop_bar"], metadata["trained"])


def keep_controller(path: Path, parameters: np.ndarray, variant: str, trained: dict) -> None:
    """Write C, float (parameters,), as float16, with the checksums of its trained V and M."""
    save_controller(path, parameters.astype(np.float16), variant=variant, **trained)


def load_kept_agent(path: Path) -> Agent:
    """The agent of a kept controller, with the V and M beside it. Raises as the loaders do."""
    world_model = load_kept_world_model(path.with_name(WORLD_MODEL_FILE))
    parameters, metadata = load_controller(path)
    check_belongs(path, metadata, **world_model.checksums)
    return Agent(world_model, parameters)


def find_world_model(networks: Path, study: str, seed: int, variant: str) -> Path:
    """The file of a kept V and M; FileNotFoundError says how to get it."""
    path = networks / study / f"seed{seed}" / variant / WORLD_MODEL_FILE
    if not path.exists():
        raise FileNotFoundError(f"{path} is not there: {how_to_get(study)}")
    return path


def how_to_get(study: str) -> str:
    """What to do about kept agents that are not there, for a message."""
    if not NETWORKS.is_dir():
        return "clone the repository of stad_lab, what pip installs does not hold them"
    return f"make them with `python -m stad_study replicate {study} --out runs/replication`"
