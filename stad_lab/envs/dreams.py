"""Many dreams at once, as a native `gymnasium.vector.VectorEnv`: M predicts for all together.

Make it by its name::

    envs = gymnasium.make_vec(
        "stad_lab:StadLab/Dream-v0", num_envs=16, agent="frame", temperature=1.0
    )
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from stad_lab.envs.arguments import check_options, numbers, whole_number
from stad_lab.envs.cars import MOST_CARS, seeds_of
from stad_lab.envs.dream import DreamEnv
from stad_lab.envs.vector import check_autoreset, check_mask
from stad_lab.models.mdn_rnn import MDNRNN, Mixture
from stad_lab.models.vae import VAE, to_uint8


class DreamVector(gym.vector.VectorEnv):
    """`num_envs` dreams, each with its own random numbers: those of a `DreamEnv` of its seed.

    An ended dream begins anew in the next step, which ignores its action (NEXT_STEP), or waits for
    a `reset` with "reset_mask" (DISABLED).

    Args:
        vae, mdn_rnn, temperature, max_frames, render_mode: as of `DreamEnv`.
        num_envs: number of dreams, 1 to 100,000.
        autoreset_mode: "NextStep" or "Disabled", or Gymnasium's `AutoresetMode`.
    """

    def __init__(
        self,
        vae: VAE,
        mdn_rnn: MDNRNN,
        num_envs: int = 1,
        temperature: float = 1.0,
        max_frames: int = 1000,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ):
        mode = check_autoreset(autoreset_mode)
        num_envs = whole_number("num_envs", num_envs, 1, MOST_CARS)
        if mode == AutoresetMode.SAME_STEP:
            raise ValueError(f"autoreset_mode={mode.value}: choose NextStep or Disabled")
        options = temperature, max_frames, render_mode
        self.dreams = [DreamEnv(vae, mdn_rnn, *options) for _ in range(num_envs)]
        self.vae, self.mdn_rnn, self.temperature = vae, mdn_rnn, temperature
        self.num_envs, self.autoreset_mode, self.render_mode = num_envs, mode, render_mode
        self.metadata = DreamEnv.metadata | {"autoreset_mode": mode}
        self.single_observation_space = self.dreams[0].observation_space
        self.single_action_space = self.dreams[0].action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended, self._begun = np.ones(num_envs, bool), False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict]:
        """Begin dreams; returns z, float32 (num_envs, latent_size), and {"hidden": h of each}.

        Args:
            seed: one for each dream, or n for n, n + 1, ...
            options: "reset_mask", bool (num_envs,), to begin only some anew. The first reset is of
                all dreams; ValueError for another mask.
        """
        self._check_open()
        mask = check_mask(check_options(options), self.num_envs, self._begun)
        seeds = seeds_of(seed, self.num_envs)
        for number in np.flatnonzero(mask).tolist():
            self.dreams[number].reset(seed=seeds[number])
        self._ended[mask], self._begun = False, True
        return self._observations(), self._info()

    @torch.no_grad()
    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Dream one frame; actions are float32 (num_envs, 3). Rewards are 0, as in `DreamEnv`.

        Raises:
            ValueError: actions of another shape, or not finite where a dream goes on.
            ResetNeeded: before the first reset.
            RuntimeError: a dream that has ended must be reset first (DISABLED).
        """
        self._check_begun()
        actions = numbers("actions", actions, "one action for each dream").astype(np.float32)
        begin, going_on = np.flatnonzero(self._ended), np.flatnonzero(~self._ended)
        shape = self.action_space.shape
        if actions.shape != shape or not np.isfinite(actions[going_on]).all():
            raise ValueError(
                f"actions of shape {actions.shape}: expected finite numbers of shape {shape}"
            )
        if len(begin) and self.autoreset_mode == AutoresetMode.DISABLED:
            raise RuntimeError(f"dreams {begin.tolist()} have ended: call reset")
        self._predict(going_on, actions[going_on])
        for number in begin:
            self.dreams[number].reset()
        frames = np.array([dream.frames for dream in self.dreams])
        self._ended = frames >= self.dreams[0].max_frames
        terminated = np.zeros(self.num_envs, bool)
        rewards, truncated = np.zeros(self.num_envs), self._ended.copy()
        return self._observations(), rewards, terminated, truncated, self._info()

    @torch.no_grad()
    def render(self) -> tuple[np.ndarray, ...] | None:
        """What V decodes from each z: uint8 (64, 64, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        self._check_begun()
        return tuple(to_uint8(self.vae.decode(torch.from_numpy(self._observations()))[0]))

    @property  # type: ignore[misc]  # as SyncVectorEnv
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The random numbers of each dream."""
        self._check_open()
        return tuple(dream.np_random for dream in self.dreams)

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The last seed of each dream."""
        self._check_open()
        return tuple(dream.np_random_seed for dream in self.dreams)

    def _predict(self, numbers: np.ndarray, actions: np.ndarray) -> None:
        """M predicts for some dreams together; each samples with its own random numbers."""
        if not len(numbers):
            return
        dreams = [self.dreams[number] for number in numbers]
        latents = torch.stack([dream.latents for dream in dreams])
        state = tuple(
            torch.cat(parts, 1) for parts in zip(*(dream.state for dream in dreams), strict=True)
        )
        prediction, after = self.mdn_rnn(
            latents[:, None], torch.from_numpy(actions)[:, None], state
        )
        for place, dream in enumerate(dreams):
            own = slice(place, place + 1)
            predicted = Mixture(*(part[own] for part in prediction))
            dream.state = tuple(part[:, own] for part in after)
            dream.latents = predicted.sample(self.temperature, dream.generator)[0, 0]
            dream.frames += 1

    def _observations(self) -> np.ndarray:
        return torch.stack([dream.latents for dream in self.dreams]).numpy()

    def _info(self) -> dict[str, Any]:
        everywhere = np.ones(self.num_envs, bool)
        return {"hidden": np.stack([one.hidden for one in self.dreams]), "_hidden": everywhere}

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError("this environment is closed: make another one")

    def _check_begun(self) -> None:
        self._check_open()
        if not self._begun:
            raise ResetNeeded("no dream has begun: call reset first")
