"""Where CMA-ES searches for C: along all of its weights, or along a few directions.

C sees z and h, 288 numbers, and has three weights for each. But a few dozen principal components
hold nearly all of their variance. With `evolution.components`, CMA-ES searches for the weights of
the leading components alone, which are fitted to the dataset. A C that is linear in them is linear
in z and h, so the result is an ordinary C.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from stad_lab.config import Config
from stad_lab.features import features_of
from stad_lab.io.files import save_tensors
from stad_lab.io.weights import WorldModel, check_belongs, load_kind, load_world_model
from stad_lab.models import controller
from stad_lab.models.controller import ACTION_SIZE, seen_columns
from stad_lab.training.dataset import Dataset

START_FILE = "start.safetensors"
COMPONENTS_FILE = "components.safetensors"


@dataclass(frozen=True)
class SearchSpace:
    """All controllers that CMA-ES can find: an origin, and the effect of a step along each axis."""

    first: np.ndarray  # where CMA-ES begins, float64 (dimensions,)
    origin: np.ndarray  # the controller at zero, float64 (parameters,)
    directions: np.ndarray  # float64 (dimensions, parameters)

    def expand(self, points: np.ndarray) -> np.ndarray:
        """The parameters of C (..., parameters) for points of the search (..., dimensions)."""
        return self.origin + points @ self.directions


def search_space(config: Config, world_model: WorldModel, folder: Path) -> SearchSpace:
    """Where the CMA-ES run in `folder` searches, and from which C.

    ValueError or FileNotFoundError if START_FILE or COMPONENTS_FILE does not fit or is missing.
    """
    start = controller.initial_parameters(*world_model.sizes, config.evolution.initial_gas)
    if config.data.agent_episodes or (folder / START_FILE).exists():
        start = load_start(folder / START_FILE, world_model)
    if config.evolution.components:
        directions = load_directions(folder / COMPONENTS_FILE, world_model)
        return SearchSpace(np.zeros(len(directions)), start, directions)
    seen = seen_columns(config.evolution.features, *world_model.sizes)
    searched = np.concatenate([np.tile(seen, ACTION_SIZE), np.ones(ACTION_SIZE, bool)])
    return SearchSpace(start[searched], np.zeros(len(start)), np.eye(len(start))[searched])


def save_start(
    path: Path, parameters: np.ndarray, variant: str, world_model: WorldModel, **made_with: str
) -> None:
    """Write the C, float64 (parameters,), that a second iteration or fine-tuning starts from."""
    tensors = {"parameters": torch.from_numpy(parameters)}
    made_with = {"variant": variant, **made_with, **world_model.checksums}
    save_tensors(path, tensors, kind="start", **made_with)


def load_start(path: Path, world_model: WorldModel) -> np.ndarray:
    """Read what `save_start` wrote. Raises as `search_space`."""
    tensors, metadata = load_kind(path, "start", "vae", "mdn_rnn")
    check_belongs(path, metadata, **world_model.checksums)
    parameters = tensors["parameters"].numpy()
    count = controller.parameter_count(*world_model.sizes)
    controller.check_parameters(parameters, count, path)
    return parameters


# Threads of BLAS that wait for the next product hold the cores that PyTorch's need: this takes
# a third of the time.
@threadpool_limits.wrap(limits=1, user_api="blas")
def find_components(config: Config, dataset: Callable[[], Dataset], folder: Path) -> bool:
    """Fit the principal components of what C sees in the dataset; writes COMPONENTS_FILE.

    False if they were there already, or `evolution.components` is 0. `dataset` opens the dataset.
    Raises as `search_space`.
    """
    count = config.evolution.components
    if not count:
        return False
    path, world_model = Path(folder) / COMPONENTS_FILE, load_world_model(Path(folder))
    depends_on: dict[str, Any] = {"count": count, "features": config.evolution.features}
    if path.exists():
        load_directions(path, world_model)  # raises if they are of another world model
        was = depends_on | load_kind(path, "components")[1]
        if all(was[name] == value for name, value in depends_on.items()):
            return False
    data = dataset()
    episodes = zip(tqdm(data.frames, "components", unit="episode"), data.actions, strict=True)
    seen = (features_of(world_model, *episode) for episode in episodes)
    columns = seen_columns(config.evolution.features, *world_model.sizes)
    found = principal_components(seen, columns, count)
    metadata = {"variant": config.variant, **depends_on, **world_model.checksums}
    save_components(path, *found, metadata)
    return True


def save_components(
    path: Path, middle: np.ndarray, components: np.ndarray, metadata: dict[str, Any]
) -> None:
    """Write what `principal_components` found."""
    tensors = {"middle": torch.from_numpy(middle), "components": torch.from_numpy(components)}
    save_tensors(path, tensors, kind="components", **metadata)


def principal_components(
    seen: Iterable[np.ndarray], columns: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The mean of the features, and the directions of their largest variance, of length 1.

    They are not scaled to equal variance: a direction in which little happens is of little use to
    C, and equal steps along all of them leave it little weight.

    Args:
        seen: of every episode, (T, features); one is held at a time.
        columns: bool (features,), those that count; the components are zero in the others.
        count: of components, at most.

    Returns:
        float64 (features,) and (components, features).
    """
    frames, total, squares = 0, np.zeros(len(columns)), np.zeros((len(columns), len(columns)))
    for episode in seen:
        episode = episode.astype(np.float64)
        frames, total = frames + len(episode), total + episode.sum(axis=0)
        squares += episode.T @ episode
    middle = total / frames
    covariance = squares / frames - np.outer(middle, middle)
    _, vectors = np.linalg.eigh(covariance[columns][:, columns])
    components = np.zeros((min(count, columns.sum()), len(columns)))
    components[:, columns] = vectors.T[::-1][:count]
    return middle, components


def load_directions(path: Path, world_model: WorldModel) -> np.ndarray:
    """What a step along each component and each bias adds to C, float64 (dimensions, parameters).

    The output along a component is its weight times the distance from the mean, so the bias
    subtracts the mean. Raises as `search_space`.
    """
    tensors, metadata = load_kind(path, "components", "vae", "mdn_rnn")
    check_belongs(path, metadata, **world_model.checksums)
    middle, components = tensors["middle"].numpy(), tensors["components"].numpy()
    outputs = np.eye(ACTION_SIZE)
    weights = np.kron(outputs, components)
    biases = np.kron(outputs, -components @ middle[:, None])
    return np.block([[weights, biases], [np.zeros((ACTION_SIZE, weights.shape[1])), outputs]])
