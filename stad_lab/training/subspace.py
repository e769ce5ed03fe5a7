"""Where CMA-ES searches for C: along each of its weights, or along the few directions in which what C sees varies.

C sees z and h, 288 numbers, and has a weight for each of them and each of its three outputs. But those numbers move
together: a few dozen principal components hold nearly all of their variance, and along the others a mutation adds
hardly more than a constant to each output, which the biases do as well. With `Settings.components`, CMA-ES searches for
the weights of the leading components alone. They are fitted to the rollouts, and cost no episode. A C that is linear in
them is linear in z and h, so what is found is an ordinary C.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tqdm.auto import tqdm

from stad_lab.agent import WorldModel, read_world_model
from stad_lab.config import Settings
from stad_lab.evaluation.trajectories import remember_drive
from stad_lab.io.files import load_tensors, save_tensors
from stad_lab.models.controller import (
    check_parameters,
    initial_parameters,
    parameter_count,
    seen_columns,
)
from stad_lab.models.mdn_rnn import ACTION_SIZE, check_partner, encode_frames
from stad_lab.models.vae import check_part
from stad_lab.training.dataset import Rollouts

START = "start.safetensors"
COMPONENTS = "components.safetensors"
MAKE_AGAIN = "run the command that made this run again, which makes it again"


@dataclass(frozen=True)
class SearchSpace:
    """All C's that a search can find: the origin, and what a step along each direction adds to it."""

    first: np.ndarray
    """Where CMA-ES begins, float64 (searched,)."""
    origin: np.ndarray
    """The C at zero, float64 (parameters,)."""
    directions: np.ndarray
    """float64 (searched, parameters)."""

    def expand(self, found: np.ndarray) -> np.ndarray:
        """The parameters of C, (..., parameters), for points of the search, (..., searched)."""
        return self.origin + found @ self.directions


def sizes(world_model: WorldModel) -> tuple[int, int]:
    """How many numbers z and h have."""
    return world_model.autoencoder.latent_size, world_model.mdn_rnn.hidden_size


def search_space(settings: Settings, world_model: WorldModel, folder: Path) -> SearchSpace:
    """Where the search of a run goes on, and from where: from nothing, or from the C of an earlier run.

    Raises:
        ValueError, FileNotFoundError: the file of that C or of the components is damaged, missing, or for another V
            and M.
    """
    start = initial_parameters(*sizes(world_model), settings.initial_gas)
    if (
        settings.agent_episodes or (folder / START).exists()
    ):  # a finish may follow a run of one round
        start = load_start(folder / START, world_model)
    if settings.components:
        directions = load_directions(folder / COMPONENTS, world_model)
        return SearchSpace(np.zeros(len(directions)), start, directions)
    seen = np.concatenate(
        [
            np.tile(seen_columns(settings.features, *sizes(world_model)), ACTION_SIZE),
            np.ones(ACTION_SIZE, bool),
        ]
    )
    return SearchSpace(start[seen], np.zeros(len(start)), np.eye(len(start))[seen])


def save_start(path: Path, parameters: np.ndarray, variant: str, world_model: WorldModel) -> None:
    """Write the C, float64 (parameters,), that a second round or a finish starts from with its V and M."""
    tensors = {"parameters": torch.from_numpy(parameters)}
    save_tensors(path, tensors, part="start", variant=variant, **world_model.identities)


def load_start(path: Path, world_model: WorldModel) -> np.ndarray:
    """The C that a second round or a finish starts from, float64 (parameters,). Raises as `search_space`."""
    tensors, facts = load_tensors(path, MAKE_AGAIN)
    check_part(path, facts, "start", None)
    check_partner(path, facts, **world_model.identities)
    parameters = tensors["parameters"].numpy()
    check_parameters(parameters, parameter_count(*sizes(world_model)), path)
    return parameters


def find_components(variant: str, settings: Settings, rollouts_folder: Path, folder: Path) -> bool:
    """Fit the principal components of what C sees in the rollouts; writes `components.safetensors`.

    Returns:
        False if there was nothing to do: they were there already, or `settings.components` is 0.

    Raises:
        ValueError, FileNotFoundError: V, M, the rollouts, or the components that are there already are damaged,
            missing, or of another run.
    """
    if not settings.components:
        return False
    path, world_model = Path(folder) / COMPONENTS, read_world_model(Path(folder), variant)
    if path.exists():
        load_directions(path, world_model)
        return False
    rollouts = Rollouts(rollouts_folder)
    drives = zip(tqdm(rollouts.frames, "components", unit="episode"), rollouts.actions, strict=True)
    seen = (features(world_model, frames, actions) for frames, actions in drives)
    middle, components = principal_components(
        seen, seen_columns(settings.features, *sizes(world_model)), settings.components
    )
    tensors = {"middle": torch.from_numpy(middle), "components": torch.from_numpy(components)}
    save_tensors(path, tensors, part="components", variant=variant, **world_model.identities)
    return True


def features(world_model: WorldModel, frames: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """What C sees in an episode: z and the h before it, float32 (T, latent_size + hidden_size)."""
    latents = encode_frames(world_model.autoencoder, frames, world_model.stride)[0]
    return np.concatenate([latents, remember_drive(world_model.mdn_rnn, latents, actions)], axis=1)


def principal_components(
    seen: Iterable[np.ndarray], columns: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The mean of what is seen, and the directions of its largest variance.

    They are not scaled to equal variance: a direction in which little happens is of little use to C, and equal steps
    along all of them leave it little weight.

    Args:
        seen: of every episode, (T, features); one is held at a time.
        columns: bool (features,), those that count; the components are zero in the others.
        count: of components, at most; there are no more than columns that count.

    Returns:
        float64 (features,), and (components, features) of length 1, that of the largest variance first.
    """
    frames, total, squares = 0, np.zeros(len(columns)), np.zeros((len(columns), len(columns)))
    for episode in seen:
        episode = episode.astype(np.float64)
        frames, total, squares = (
            frames + len(episode),
            total + episode.sum(axis=0),
            squares + episode.T @ episode,
        )
    middle = total / frames
    covariance = squares / frames - np.outer(middle, middle)
    _, vectors = np.linalg.eigh(covariance[columns][:, columns])
    components = np.zeros((min(count, columns.sum()), len(columns)))
    components[:, columns] = vectors.T[::-1][:count]
    return middle, components


def load_directions(path: Path, world_model: WorldModel) -> np.ndarray:
    """What a step along each component adds to the parameters of C, and along its three biases: (searched, parameters).

    C's output along a component c is its weight times c's distance from the middle, so the bias takes the middle off.
    Raises as `search_space`.
    """
    tensors, facts = load_tensors(path, MAKE_AGAIN)
    check_part(path, facts, "components", None)
    check_partner(path, facts, **world_model.identities)
    middle, components = tensors["middle"].numpy(), tensors["components"].numpy()
    outputs = np.eye(ACTION_SIZE)
    weights, biases = np.kron(outputs, components), np.kron(outputs, -components @ middle[:, None])
    return np.block([[weights, biases], [np.zeros((ACTION_SIZE, weights.shape[1])), outputs]])
