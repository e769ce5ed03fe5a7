"""The agent: V, M and C together. It sees observations and gives actions, for one car or for many in step.

At every frame: V makes z of the frame and its difference image; C makes the action of z and M's memory h; M takes in z
and the action. C sees the mean mu of z, not a sample: driving has no use for the noise.
"""

import functools
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from stad_lab.envs.car_racing import MAX_FRAMES, make_env
from stad_lab.envs.frames import FrameMemory, to_frame
from stad_lab.io.files import load_tensors, save_tensors
from stad_lab.models.controller import check_parameters, control, parameter_count
from stad_lab.models.mdn_rnn import MDNRNN, State, check_partner, load_mdn_rnn
from stad_lab.models.vae import (
    REMEDY,
    AutoEncoder,
    check_part,
    check_variant,
    load_autoencoder,
    to_pictures,
)

PRETRAINED = Path(__file__).parent / "pretrained"
CONTROLLER = "controller.safetensors"  # the file of C


class Agent:
    """V + M + C.

    Attributes:
        latents: z of the last frame, float32 (cars, latent_size); None before the first.
        hidden: M's memory h that C saw with it, float32 (cars, hidden_size).
        state: M's memory (h, c) after the last action, float32 (1, cars, hidden_size) each; None before the first.

    Args:
        parameters: of C, (parameters,) or one row for each car (cars, parameters).
        stride: k of the difference image, as V was trained.
        crop_bar: whether V was trained on frames without the indicator bar.

    Raises:
        ValueError: parameters of another number than V's latents and M's memory ask for.
    """

    def __init__(
        self,
        autoencoder: AutoEncoder,
        mdn_rnn: MDNRNN,
        parameters: np.ndarray,
        stride: int,
        crop_bar: bool,
    ):
        check_parameters(parameters, parameter_count(autoencoder.latent_size, mdn_rnn.hidden_size))
        self.autoencoder, self.mdn_rnn, self.parameters = autoencoder, mdn_rnn, parameters
        self.stride, self.crop_bar = stride, crop_bar
        self.reset()

    def reset(self) -> None:
        """Forget the past: every episode begins with this."""
        self.memory = FrameMemory(self.stride)
        self.cars: np.ndarray | None = (
            None  # which of the cars of the first step still drive, int (cars,)
        )
        self.state: State | None = None
        self.latents: np.ndarray | None = None
        self.hidden: np.ndarray | None = None

    def act(self, observation: np.ndarray) -> np.ndarray:
        """The action for one car: observation uint8 (96, 96, 3) -> float32 (3,), steering, gas, brake.

        Raises:
            ValueError: an observation of another shape or dtype, or an action that is not finite.
        """
        return self.act_batch([observation])[0]

    @torch.inference_mode()
    def act_batch(self, observations: np.ndarray | list[np.ndarray]) -> np.ndarray:
        """The actions for cars that drive in step: uint8 (cars, 96, 96, 3) -> float32 (cars, 3).

        Raises:
            ValueError: as `act`, or another number of cars than in the step before without a `reset`.
        """
        self._check_count(len(observations))
        frames = np.stack([to_frame(observation, self.crop_bar) for observation in observations])
        if self.cars is None:
            self.cars = np.arange(len(frames))
        frame, difference = to_pictures(frames, self.memory.push(frames))
        latents, _ = self.autoencoder.encode(frame, difference)
        if self.state is None:
            self.state = tuple(
                torch.zeros(1, len(frames), self.mdn_rnn.hidden_size) for _ in range(2)
            )
        self.latents, self.hidden = latents.numpy(), self.state[0][0].numpy()
        actions = control(
            self.present_parameters(), np.concatenate([self.latents, self.hidden], axis=1)
        )
        self.take_in(actions, self.state)
        return actions

    @torch.inference_mode()
    def take_in(self, actions: np.ndarray, before: State | None) -> None:
        """Let M remember the last z with these actions, float32 (cars, 3).

        `act` does it with its own. Whoever drives otherwise calls it again, with what was done in truth.

        Args:
            before: `state` as it was before that `act`.

        Raises:
            ValueError: the agent has not acted since its reset.
        """
        self._check_acted()
        seen, done = torch.from_numpy(self.latents)[:, None], torch.from_numpy(actions)[:, None]
        _, self.state = self.mdn_rnn.remember(seen, done, before)

    def present_parameters(self) -> np.ndarray:
        """C's parameters for the present cars: one vector for all, or a row for each."""
        return self.parameters[self.cars] if self.parameters.ndim == 2 else self.parameters

    def keep(self, cars: np.ndarray) -> None:
        """Go on with some of the cars only, until the next reset: `cars` are their indices among the present ones.

        Raises:
            ValueError: the agent has not acted since its reset.
        """
        self._check_acted()
        self.memory.keep(cars)
        self.state = tuple(part[:, cars] for part in self.state)
        self.latents, self.hidden, self.cars = (
            self.latents[cars],
            self.hidden[cars],
            self.cars[cars],
        )

    def _check_acted(self) -> None:
        if self.latents is None:
            raise ValueError("the agent has not acted yet: call agent.act(observation) first")

    def _check_count(self, count: int) -> None:
        if count == 0:
            raise ValueError("0 observations: expected at least 1")
        if self.cars is None and self.parameters.ndim == 2 and count != len(self.parameters):
            raise ValueError(
                f"{count} observations for {len(self.parameters)} controllers:"
                " expected one observation for each row of the parameters"
            )
        if self.cars is not None and count != len(self.cars):
            raise ValueError(
                f"{count} observations, expected {len(self.cars)}, as in the step before:"
                " call agent.reset() when an episode begins"
            )


def drive(
    agent: Agent,
    tracks: list[int],
    fast: bool = True,
    max_frames: int = MAX_FRAMES,
    patience: int = 0,
    top_speed: float = math.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """Drive one episode on each track, all cars in step. Each holds 16 MB, its painted track, until its episode ends.

    Args:
        agent: its parameters are one vector, or one row for each track.
        tracks: seeds of the tracks.
        fast: draw observations with the fast renderer, or with Gymnasium's own.
        max_frames: cut an episode after so many frames (CarRacing's own limit is 1,000).
        patience: end an episode that has reached no new tile for so many frames; 0 for never.
        top_speed: in world units per second; above it no gas reaches the car, and M is not told.

    Returns:
        The returns, float64 (tracks,), and the lengths in frames, int (tracks,).

    Raises:
        ValueError: as `Agent.act_batch`, fewer than one frame, or a track below 0.
    """
    if max_frames < 1:
        raise ValueError(f"max_frames={max_frames}: expected at least 1")
    tracks = [
        int(track) for track in tracks
    ]  # those of an array are NumPy's, which Gymnasium refuses
    if min(tracks, default=0) < 0:
        raise ValueError(f"track {min(tracks)}: expected at least 0, the seeds of tracks")
    unseen = {"bar": False} if fast and agent.crop_bar else {}  # what V crops need not be drawn
    envs = [make_env(fast, **unseen) for _ in tracks]
    observations = [env.reset(seed=track)[0] for env, track in zip(envs, tracks, strict=True)]
    returns, lengths = np.zeros(len(tracks)), np.zeros(len(tracks), int)
    last_tile = np.zeros(len(tracks), int)  # the frame in which a car last reached a new tile
    driving = list(range(len(tracks)))
    agent.reset()
    while driving:
        going_on = []
        for place, (car, action) in enumerate(
            zip(driving, agent.act_batch(observations), strict=True)
        ):
            if (
                top_speed < math.inf
                and envs[car].unwrapped.car.hull.linearVelocity.length > top_speed
            ):
                action[1] = 0.0
            observations[place], reward, terminated, truncated, _ = envs[car].step(action)
            returns[car] += reward
            lengths[car] += 1
            if reward > 0:
                last_tile[car] = lengths[car]
            lost = patience and lengths[car] - last_tile[car] >= patience
            if not (terminated or truncated or lost or lengths[car] >= max_frames):
                going_on.append(place)
            else:
                envs[car].close()  # lets go of its painted track
        if len(going_on) < len(driving):
            driving, observations = (
                [driving[p] for p in going_on],
                [observations[p] for p in going_on],
            )
            agent.keep(np.array(going_on, int))
    return returns, lengths


class WorldModel(NamedTuple):
    """V and M of one run, and how V's pictures are made."""

    autoencoder: AutoEncoder
    mdn_rnn: MDNRNN
    stride: int
    crop_bar: bool
    identities: dict[str, str]
    """Checksums by which C knows the "autoencoder" and the "mdn_rnn" that it was evolved with."""


def read_world_model(folder: Path, variant: str) -> WorldModel:
    """V and M of a run. Raises ValueError if they do not belong together, and as `load_autoencoder`."""
    autoencoder, v_facts = load_autoencoder(folder / "autoencoder.safetensors", variant)
    path = folder / "mdn_rnn.safetensors"
    mdn_rnn, m_facts = load_mdn_rnn(path, variant)
    check_partner(path, m_facts, autoencoder=v_facts["identity"])
    identities = {"autoencoder": v_facts["identity"], "mdn_rnn": m_facts["identity"]}
    return WorldModel(autoencoder, mdn_rnn, v_facts["stride"], v_facts["crop_bar"], identities)


def load_world_model(folder: Path, variant: str) -> WorldModel:
    """As `read_world_model`, but kept for as long as the files are the same, so that workers read them once."""
    files = [folder / name for name in ("autoencoder.safetensors", "mdn_rnn.safetensors")]
    return read_once(
        folder, variant, tuple(file.stat().st_mtime_ns if file.exists() else 0 for file in files)
    )


@functools.lru_cache(maxsize=2)
def read_once(folder: Path, variant: str, changed: tuple[int, int]) -> WorldModel:
    """`read_world_model`, once for all calls with the same times at which the two files `changed`."""
    return read_world_model(folder, variant)


def run_folder(variant: str, path: str | Path | None = None) -> Path:
    """The folder of a run: `path`, or that of the agent that comes with stad_lab, of a second round if of no first."""
    if path is not None:
        return Path(path)
    folders = [PRETRAINED / variant, PRETRAINED / "second_round" / variant]
    return next((folder for folder in folders if (folder / CONTROLLER).exists()), folders[0])


def load_agent(variant: str, path: str | Path | None = None) -> Agent:
    """Load a trained agent.

    Args:
        variant: "frame", "input", "output" or "input_output".
        path: the folder of a run; None for the one that comes with stad_lab. For "input" that is the agent of one long
            search that the notebooks show, without the bar and no match for the other three, which a second round and
            a finish have made: to compare variants, give `pretrained/second_round/input`.

    Raises:
        ValueError: an unknown variant, or files that are damaged or belong to another variant or size.
        FileNotFoundError: no such run, or the run is not finished.
    """
    check_variant(variant)
    folder = run_folder(variant, path)
    if path is None and not (folder / CONTROLLER).exists():
        shipped = ", ".join(sorted({file.parent.name for file in PRETRAINED.rglob(CONTROLLER)}))
        raise FileNotFoundError(
            f"no trained {variant!r} agent comes with stad_lab, only {shipped or 'none at all'}: train one with"
            f" `python -m stad_lab train --variant {variant} --out runs/{variant}` and give path='runs/{variant}'"
        )
    if not folder.is_dir() or not any(folder.iterdir()):
        raise FileNotFoundError(
            f"{folder} is {'empty' if folder.is_dir() else 'not a folder'}: expected a run made by"
            f" `python -m stad_lab train --variant {variant} --out {folder}`"
        )
    world_model, path = read_world_model(folder, variant), folder / CONTROLLER
    parameters, facts = load_controller(path, variant)
    agent = Agent(
        world_model.autoencoder,
        world_model.mdn_rnn,
        parameters,
        world_model.stride,
        world_model.crop_bar,
    )
    check_partner(path, facts, **world_model.identities)
    return agent


def save_controller(path: Path, parameters: np.ndarray, **facts) -> None:
    """Write C's parameters, float64 (parameters,), with facts about where they come from."""
    save_tensors(path, {"parameters": torch.from_numpy(parameters)}, part="controller", **facts)


def load_controller(path: Path, variant: str) -> tuple[np.ndarray, dict]:
    """Read C: (its parameters, float64 (parameters,), and the facts it was saved with).

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged, not C, of another variant, or not finite.
    """
    tensors, facts = load_tensors(path, REMEDY)
    check_part(path, facts, "controller", variant)
    parameters = tensors["parameters"].double().numpy()
    check_parameters(parameters, parameters.shape[-1], path)
    return parameters, facts
