"""The dream: M as a gymnasium.Env. The car drives inside the model, and nothing of CarRacing runs.

An observation is a latent z; `render()` has V draw it. Each step M predicts a mixture for the next z from z, the action
and its memory, and one z is drawn from it. As in World Models' CarRacing, M predicts neither reward nor the end of an
episode: the reward is always 0, and a dream is cut after `max_frames`.
"""

import gymnasium as gym
import numpy as np
import torch

from stad_lab.agent import Agent
from stad_lab.envs.car_racing import MAX_FRAMES
from stad_lab.models.controller import control
from stad_lab.models.mdn_rnn import (
    ACTION_SIZE,
    MDNRNN,
    Mixture,
    State,
    check_temperature,
    sample_mixture,
)
from stad_lab.models.vae import AutoEncoder, to_uint8


class DreamEnv(gym.Env):
    """Drive inside M.

    Observations are z, float32 (latent_size,); actions are CarRacing's, float32 (3,). `info["hidden"]` is M's memory h,
    float32 (hidden_size,), which a controller may want to see with z.

    Attributes:
        temperature: of the sampling, above 0; may be changed between steps.
        prediction: the mixture from which the present z was drawn; None right after `reset`.

    Args:
        autoencoder, mdn_rnn: V and M, of one run.
        temperature: 1 is what M has learned, below 1 is calmer, above 1 is wilder.
        max_frames: length of a dream.
        render_mode: "rgb_array" for pictures from `render()`, or None.

    Raises:
        ValueError: a temperature that is not above 0, or another render mode.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        autoencoder: AutoEncoder,
        mdn_rnn: MDNRNN,
        temperature: float = 1.0,
        max_frames: int = MAX_FRAMES,
        render_mode: str | None = None,
    ):
        check_temperature(temperature)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(
                f"render_mode={render_mode!r}: a dream can be rendered as 'rgb_array' only, or not (None)"
            )
        self.autoencoder, self.mdn_rnn = autoencoder, mdn_rnn
        self.temperature, self.max_frames, self.render_mode = temperature, max_frames, render_mode
        self.observation_space = gym.spaces.Box(
            -np.inf, np.inf, (autoencoder.latent_size,), np.float32
        )
        self.action_space = gym.spaces.Box(
            np.array([-1, 0, 0], np.float32), np.ones(ACTION_SIZE, np.float32)
        )
        self.latents: torch.Tensor | None = None

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict]:
        """Begin a dream.

        Args:
            seed: of the dream's random source.
            options: {"latents": z to begin with, float32 (latent_size,), "state": M's memory (h, c)}; without
                "latents" a z is drawn from N(0, 1), without "state" the memory is empty.

        Returns:
            z and {"hidden": h}.

        Raises:
            ValueError: latents or a memory of another shape, or not finite.
        """
        super().reset(seed=seed)
        options = options or {}
        self.generator = torch.Generator().manual_seed(int(self.np_random.integers(2**31)))
        size = self.autoencoder.latent_size
        latents = options.get("latents")
        if latents is None:
            latents = self.np_random.standard_normal(size)
        self.latents = torch.tensor(np.asarray(latents, np.float32))
        check_numbers("latents", self.latents, (size,), "V's z")
        zeros = torch.zeros(1, 1, self.mdn_rnn.hidden_size)
        self.state: State = options.get("state") or (zeros, zeros.clone())
        for part in self.state:
            check_numbers("a memory", part, tuple(zeros.shape), "M's h and c of one car")
        self.prediction: Mixture | None = None
        self.frames = 0
        return self.latents.numpy().copy(), self._info()

    @torch.no_grad()
    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Dream one frame on: (z, 0.0, False, whether `max_frames` is reached, {"hidden": h}).

        Raises:
            ValueError: an action that is not three finite numbers, or a temperature that was set to 0 or less.
            RuntimeError: called before `reset`.
        """
        if self.latents is None:
            raise RuntimeError("step before reset: call reset() to begin a dream")
        action = np.asarray(action, np.float32)
        if action.shape != (ACTION_SIZE,) or not np.isfinite(action).all():
            raise ValueError(
                f"action {action}: expected three finite numbers, steering, gas and brake"
            )
        self.prediction, self.state = self.mdn_rnn(
            self.latents[None, None], torch.from_numpy(action)[None, None], self.state
        )
        self.latents = sample_mixture(self.prediction, self.temperature, self.generator)[0, 0]
        self.frames += 1
        return self.latents.numpy().copy(), 0.0, False, self.frames >= self.max_frames, self._info()

    @torch.no_grad()
    def render(self) -> np.ndarray | None:
        """What V makes of the present z: uint8 (64, 64, 3); None without a render mode.

        Raises:
            RuntimeError: called before `reset`.
        """
        if self.render_mode is None:
            return None
        if self.latents is None:
            raise RuntimeError("render before reset: call reset() to begin a dream")
        return to_uint8(self.autoencoder.decode(self.latents[None])[0])[0]

    def _info(self) -> dict:
        return {"hidden": self.state[0][0, 0].numpy().copy()}


def check_numbers(name: str, found: torch.Tensor, shape: tuple[int, ...], meaning: str) -> None:
    """Raise ValueError unless a tensor has this shape and its numbers are finite."""
    finite = torch.isfinite(found)
    if tuple(found.shape) != shape or not finite.all():
        raise ValueError(
            f"{name} of shape {tuple(found.shape)}, {finite.sum()} of them finite: expected {shape} finite numbers,"
            f" {meaning}"
        )


@torch.no_grad()
def dream_on(
    agent: Agent, frames: int, temperature: float = 1.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Let an agent that has just acted in the real environment go on driving with its eyes closed.

    The dream begins with what M, after the agent's last action, expects to see next; from there on C sees the dream.
    The agent itself is not changed. For an agent that drives one car.

    Returns:
        The dreamed frames, uint8 (frames, 64, 64, 3), and the actions, float32 (frames, 3).

    Raises:
        ValueError: the agent has not acted since its last reset, or drives several cars; or fewer than one frame.
    """
    if agent.state is None:
        raise ValueError(
            "the agent has not acted yet: let it drive a few real frames, then dream on"
        )
    if frames < 1:
        raise ValueError(f"frames={frames}: expected at least 1")
    if len(agent.cars) != 1:
        raise ValueError(
            f"the agent drives {len(agent.cars)} cars: expected one, so go on with agent.keep(np.array([0]))"
        )
    expected = agent.mdn_rnn.mixture(agent.state[0].transpose(0, 1))
    latents = sample_mixture(expected, temperature, torch.Generator().manual_seed(seed))[
        0, 0
    ].numpy()
    env = DreamEnv(agent.autoencoder, agent.mdn_rnn, temperature, frames, render_mode="rgb_array")
    latents, info = env.reset(seed=seed, options={"latents": latents, "state": agent.state})
    parameters, pictures, actions = agent.present_parameters(), [], []
    for _ in range(frames):
        pictures.append(env.render())
        actions.append(control(parameters, np.concatenate([latents, info["hidden"]])[None])[0])
        latents, _, _, _, info = env.step(actions[-1])
    return np.array(pictures), np.array(actions)
