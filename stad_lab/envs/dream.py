"""The dream: M as a gymnasium.Env. The car drives inside the model, without CarRacing.

An observation is a latent z, which `render()` decodes with V. In each step M predicts a mixture for
the next z from z, the action and its memory, and one z is sampled from it. As in World Models'
CarRacing, M predicts neither reward nor the end of an episode: the reward is always 0, and a dream
ends after `max_frames`.
"""

import gymnasium as gym
import numpy as np
import torch

from stad_lab.envs.arguments import check_options, choice, finite_array, shown, whole_number
from stad_lab.envs.car_racing import action_space
from stad_lab.models.controller import ACTION_SIZE
from stad_lab.models.mdn_rnn import MDNRNN, check_temperature
from stad_lab.models.vae import VAE, to_uint8


class DreamEnv(gym.Env):
    """Drive inside M.

    Observations are z, float32 (latent_size,); actions are CarRacing's, float32 (3,).
    `info["hidden"]` is M's memory h, float32 (hidden_size,), which C sees beside z.

    Attributes:
        temperature: of the sampling, at least 1e-6; may be changed between steps.

    Args:
        vae, mdn_rnn: V and M, of one run.
        temperature: 1 samples from M's own distribution, below 1 from a narrower one.
        max_frames: length of a dream.
        render_mode: "rgb_array" for pictures from `render()`, or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        vae: VAE,
        mdn_rnn: MDNRNN,
        temperature: float = 1.0,
        max_frames: int = 1000,
        render_mode: str | None = None,
    ):
        check_temperature(temperature)
        choice("render_mode", render_mode, (None, "rgb_array"))
        max_frames = whole_number("max_frames", max_frames, 1)
        self.vae, self.mdn_rnn = vae, mdn_rnn
        self.temperature, self.max_frames, self.render_mode = temperature, max_frames, render_mode
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (vae.latent_size,), np.float32)
        self.action_space = action_space()
        self.latents: torch.Tensor = None  # type: ignore[assignment]  # until reset

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict]:
        """Begin a dream; returns z and {"hidden": h}.

        Args:
            seed: of the dream's random source.
            options: {"latents": the first z, float32 (latent_size,), "state": M's memory (h, c),
                float32 (1, 1, hidden_size) each}; without "latents" z is sampled from N(0, 1),
                without "state" the memory is empty. ValueError for another shape or numbers that
                are not finite.
        """
        super().reset(seed=seed)
        options = check_options(options)
        self.generator = torch.Generator().manual_seed(int(self.np_random.integers(2**31)))
        size, zeros = self.vae.latent_size, torch.zeros(1, 1, self.mdn_rnn.hidden_size)
        latents, state = options.get("latents"), options.get("state")
        if latents is None:
            latents = self.np_random.standard_normal(size)
        latents = finite_array("latents", latents, (size,), "z of V")
        state = (zeros, zeros) if state is None else state
        if not isinstance(state, tuple | list) or len(state) != 2:
            raise ValueError(f"state={shown(state)}: expected M's memory (h, c)")
        parts = (("memory", part, tuple(zeros.shape), "h and c of one car") for part in state)
        self.state = tuple(torch.tensor(finite_array(*part)) for part in parts)
        self.latents, self.frames = torch.tensor(latents), 0
        return self.latents.numpy().copy(), {"hidden": self.hidden}

    @property
    def hidden(self) -> np.ndarray:
        """M's memory h, a copy: float32 (hidden_size,)."""
        return self.state[0][0, 0].numpy().copy()

    @torch.no_grad()
    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Dream one frame: (z, 0.0, False, whether `max_frames` is reached, {"hidden": h})."""
        self._check_begun("step")
        action = finite_array("action", action, (ACTION_SIZE,), "steering, gas and brake")
        prediction, self.state = self.mdn_rnn(
            self.latents[None, None], torch.from_numpy(action)[None, None], self.state
        )
        self.latents = prediction.sample(self.temperature, self.generator)[0, 0]
        self.frames += 1
        truncated = self.frames >= self.max_frames
        return self.latents.numpy().copy(), 0.0, False, truncated, {"hidden": self.hidden}

    @torch.no_grad()
    def render(self) -> np.ndarray | None:
        """What V decodes from the present z: uint8 (64, 64, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        self._check_begun("render")
        return to_uint8(self.vae.decode(self.latents[None])[0])[0]

    def _check_begun(self, call: str) -> None:
        if self.latents is None:
            raise RuntimeError(f"{call} before reset: call reset() to begin a dream")
