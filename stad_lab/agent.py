"""The agent, V + M + C: it sees observations and gives actions. And `rollout`, which drives.

At every frame V encodes the frame and its difference image into z, C computes the action from z and
M's memory h, and M updates its memory with z and the action. C sees the mean mu of z, not a sample.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np

from stad_lab.envs.arguments import car_numbers, finite_array, numbers, shown, whole_number
from stad_lab.envs.car_racing import MAX_FRAMES, make_env
from stad_lab.envs.cars import Cars
from stad_lab.envs.frames import FRAME_SIZE, FrameMemory, to_frame
from stad_lab.inference import Inference
from stad_lab.io.weights import (
    CONTROLLER_FILE,
    WorldModel,
    check_belongs,
    load_controller,
    load_world_model,
)
from stad_lab.io.workers import check_cancelled
from stad_lab.models.controller import check_parameters, control, parameter_count

PRETRAINED = Path(__file__).parent / "pretrained"


class Agent:
    """V + M + C, for one car or for a batch of cars.

    Attributes:
        latents: z of the last frame, float32 (cars, latent_size); None before the first.
        hidden: M's memory h that C saw with it, float32 (cars, hidden_size).
        state: M's memory, h and c, after the last action, float32 (2, cars, hidden_size); None
            before the first.

    Args:
        world_model: V and M.
        parameters: of C, finite, (parameters,), or a row for each car (cars, parameters).
        remembers: whether M updates its memory; a C that does not see h drives the same without.
    """

    def __init__(self, world_model: WorldModel, parameters: np.ndarray, remembers: bool = True):
        check_parameters(parameters, parameter_count(*world_model.sizes))
        self.world_model, self.parameters = world_model, parameters
        self.vae, self.mdn_rnn = world_model.vae, world_model.mdn_rnn
        self.inference, self.remembers = Inference(self.vae, self.mdn_rnn), remembers
        self.reset()

    def reset(self) -> None:
        """Forget the past: every episode begins with this."""
        self.frame_memory = FrameMemory(self.world_model.stride)
        self.cars: Any = None  # which of the first step's cars still drive, an array (cars,)
        self.state: Any = None  # these are arrays from the first step on
        self.latents: Any = None
        self.hidden: Any = None

    def act(self, observation: np.ndarray) -> np.ndarray:
        """The action for one car: observation uint8 (96, 96, 3) -> float32 (3,).

        Steering is in [-1, 1], gas and brake are in [0, 1]. ValueError for another shape or dtype,
        for an action that is not finite, or if the agent drives several cars.
        """
        return self.act_batch([to_frame(observation, self.world_model.crop_bar)])[0]

    def act_batch(self, seen: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
        """The actions for a batch of cars: float32 (cars, 3). ValueError as `act`.

        Args:
            seen: observations, uint8 (cars, 96, 96, 3), or frames, uint8 (cars, 64, 64, 3), with
                the bar cropped as V was trained. Their number changes only by `keep` or `reset`.
        """
        seen = numbers("seen", seen, "an observation of each car")
        self._check_count(len(seen) if seen.ndim == 4 else 0)
        if seen.shape[1:] != (FRAME_SIZE, FRAME_SIZE, 3) or seen.dtype != np.uint8:
            seen = [to_frame(observation, self.world_model.crop_bar) for observation in seen]
        frames = np.asarray(seen)
        if self.state is None:
            self.cars, self.state = np.arange(len(frames)), self._zero_state(len(frames))
        self.latents = self.inference.encode(frames, self.frame_memory.push(frames))
        self.hidden = self.state[0]
        actions = control(self.present_parameters(), self.features())
        if self.remembers:
            self.state = self.inference.remember(self.latents, actions, self.state)
        return actions

    def features(self) -> np.ndarray:
        """What C sees: z and h side by side, float32 (cars, latent_size + hidden_size)."""
        return np.concatenate([self.latents, self.hidden], axis=1)

    def remember(self, actions: np.ndarray, before: np.ndarray | None) -> None:
        """Update M's memory with the last z and these finite actions, float32 (cars, 3).

        `act` does it with its own actions. A driver that changes them calls this again.

        Args:
            before: `state` as it was before that `act`; None before an episode's first.
        """
        self._check_acted()
        actions = finite_array("actions", actions, (len(self.latents), 3), "one row for each car")
        before = self._zero_state(len(self.latents)) if before is None else before
        self.state = self.inference.remember(self.latents, actions, before)

    def present_parameters(self) -> np.ndarray:
        """C's parameters for the present cars: one vector for all, or a row for each."""
        return self.parameters[self.cars] if self.parameters.ndim == 2 else self.parameters

    def keep(self, cars: np.ndarray) -> None:
        """Continue with some of the present cars, by their indices, until the next reset."""
        self._check_acted()
        cars = car_numbers(cars, len(self.cars))
        self.frame_memory.keep(cars)
        self.state = self.state[:, cars]
        self.latents, self.hidden = self.latents[cars], self.hidden[cars]
        self.cars = self.cars[cars]

    def _zero_state(self, cars: int) -> np.ndarray:
        return np.zeros((2, cars, self.mdn_rnn.hidden_size), np.float32)

    def _check_acted(self) -> None:
        if self.latents is None:
            raise ValueError("the agent has not acted yet: call agent.act(observation) first")

    def _check_count(self, count: int) -> None:
        controllers = len(self.parameters) if self.parameters.ndim == 2 else None
        expected = controllers if self.cars is None else len(self.cars)
        if count == 0 or expected not in (None, count):
            raise ValueError(
                f"{count} observations, expected {expected or 'at least 1'}: give one for each car,"
                " and call agent.reset() when an episode begins"
            )


class Driver(Protocol):
    """What `rollout` needs: an Agent, or anything else that acts."""

    def reset(self) -> None:
        """Begin new episodes."""

    def act_batch(self, seen: np.ndarray) -> np.ndarray:
        """Actions float32 (cars, 3) for pictures uint8 (cars, 64, 64, 3) or (cars, 96, 96, 3)."""

    def keep(self, cars: np.ndarray) -> None:
        """Continue with some of the present cars, by their indices."""


class EnvBatch:
    """Gymnasium environments as a batch, given with their first observations after a reset."""

    def __init__(self, envs: Sequence[gym.Env], observations: Sequence[np.ndarray]):
        self.envs, self.observations = envs, list(observations)

    def __len__(self) -> int:
        return len(self.envs)

    def draw(self, which: np.ndarray) -> np.ndarray:
        """What some cars see: uint8 (n, 96, 96, 3) from CarRacing."""
        return np.stack([self.observations[car] for car in which])

    def step(self, actions: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Drive cars one frame: rewards, float64 (n,), and whether episodes ended, bool (n,)."""
        rewards, ended = [], []
        for car, action in zip(which, actions, strict=True):
            self.observations[car], reward, terminated, truncated, _ = self.envs[car].step(action)
            rewards.append(reward)
            ended.append(terminated or truncated)
        return np.array(rewards, float), np.array(ended, bool)


class Episodes(NamedTuple):
    """What `rollout` returns."""

    returns: np.ndarray  # float64 (episodes,)
    lengths: np.ndarray  # frames, int (episodes,)
    rewards: list[list[float]]  # of every frame, for each episode


def rollout(
    driver: Driver,
    batch: Cars | EnvBatch,
    max_frames: int = MAX_FRAMES,
    patience: int = 0,
    observe: Callable[[np.ndarray, np.ndarray, np.ndarray], None] | None = None,
) -> Episodes:
    """Drive one episode with each car of a batch.

    Args:
        driver: sees the pictures of the cars that still drive.
        batch: of cars at the start of their episodes.
        max_frames: of an episode, at most 1,000 as in CarRacing.
        patience: maximum number of frames without a new tile; 0 for no limit.
        observe: called before every step with the cars' indices, what they see, and actions.
    """
    max_frames = whole_number("max_frames", max_frames, 1)
    patience = whole_number("patience", patience)
    returns, rewards = np.zeros(len(batch)), [list[float]() for _ in range(len(batch))]
    last_tile = np.zeros(len(batch), int)  # the frame in which a car last reached a new tile
    driving = np.arange(len(batch))
    driver.reset()
    for length in range(1, min(max_frames, MAX_FRAMES) + 1):
        check_cancelled()
        seen = batch.draw(driving)
        actions = driver.act_batch(seen)
        if observe:
            observe(driving, seen, actions)
        gained, ended = batch.step(actions, driving)
        returns[driving] += gained
        for car, reward in zip(driving, gained.tolist(), strict=True):
            rewards[car].append(reward)
        last_tile[driving[gained > 0]] = length
        going_on = ~ended & (length - last_tile[driving] < (patience or math.inf))
        driving = driving[going_on]
        if not len(driving):
            break
        if not going_on.all():
            driver.keep(np.flatnonzero(going_on))
    return Episodes(returns, np.array([len(own) for own in rewards]), rewards)


def drive(agent: Agent, tracks: Sequence[int], fast: bool = True, **limits) -> Episodes:
    """Let an agent drive one episode on each track, from rest. Each car holds 5 MB.

    Args:
        agent: its parameters are one vector, or one row for each track.
        tracks: seeds of the tracks, whole numbers from 0 on; one or more.
        fast: use our engine, which draws the agent's frames directly, not Gymnasium's environment.
        **limits: `max_frames`, `patience` and `observe` of `rollout`.
    """
    if not isinstance(tracks, Sequence | np.ndarray) or not np.size(tracks):
        raise ValueError(f"tracks={shown(tracks)}: expected the seed of at least one track")
    tracks = [whole_number("track", track) for track in tracks]
    if fast:
        cars = Cars(len(tracks), "frame", bar=not agent.world_model.crop_bar)
        cars.reset(tracks)
        return rollout(agent, cars, **limits)
    with ExitStack() as stack:
        envs = [stack.enter_context(make_env(fast=False)) for _ in tracks]
        first = [env.reset(seed=track)[0] for env, track in zip(envs, tracks, strict=True)]
        return rollout(agent, EnvBatch(envs, first), **limits)


def shipped_agents() -> list[str]:
    """Names of the agents that come with stad_lab."""
    return sorted(file.parent.name for file in PRETRAINED.glob(f"*/{CONTROLLER_FILE}"))


def run_folder(source: str | Path) -> Path:
    """The folder of a shipped agent, by its name, or of a run. ValueError for another type."""
    if not isinstance(source, str | Path):
        raise ValueError(
            f"agent {shown(source)}: expected a shipped agent's name or a run's folder"
        )
    shipped = {folder.name for folder in PRETRAINED.iterdir()}
    return PRETRAINED / source if source in shipped else Path(source)


def load_agent(source: str | Path, controller: str | Path | None = None) -> Agent:
    """Load a trained agent.

    Args:
        source: the name of a shipped agent, see `shipped_agents`; or the folder of a run, as a
            Path where it could be such a name.
        controller: a file of another C for this V and M, as the browser saves it; None: its own.

    Raises:
        FileNotFoundError: no such agent or file, or the agent's run is not finished.
        ValueError: files that are damaged or do not belong together.
    """
    folder = run_folder(source)
    if not (folder / CONTROLLER_FILE).exists():
        raise FileNotFoundError(
            f"no trained agent named {str(source)!r}: expected {', '.join(shipped_agents())}, or"
            " the folder of a finished run of `python -m stad_lab train`"
        )
    parameters, metadata = load_controller(file := Path(controller or folder / CONTROLLER_FILE))
    world_model = load_world_model(folder)
    agent = Agent(world_model, parameters)
    check_belongs(file, metadata, **world_model.checksums)
    return agent
