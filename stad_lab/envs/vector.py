"""CarRacing-v3 for many cars at once, as a native `gymnasium.vector.VectorEnv`.

Make it by its name::

    envs = gymnasium.make_vec("stad_lab:StadLab/CarRacing-v3", num_envs=16)
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from stad_lab.envs import physics
from stad_lab.envs.arguments import check_options, choice, numbers, shown, whole_number
from stad_lab.envs.car_racing import MAX_FRAMES, action_space, check_skip
from stad_lab.envs.cars import MOST_CARS, Cars, check_rules, seeds_of
from stad_lab.envs.frames import OBSERVATION_SIZE
from stad_lab.envs.own_track import Checkpoints
from stad_lab.envs.views import View


def check_autoreset(mode: AutoresetMode | str) -> AutoresetMode:
    """Gymnasium's mode of a name. ValueError for another one."""
    names = {one.value: one for one in AutoresetMode}
    if isinstance(mode, AutoresetMode):
        return mode
    return names[choice("autoreset_mode", mode, names)]


def check_mask(options: dict, count: int, begun: bool) -> np.ndarray:
    """The "reset_mask" of a reset, bool (count,); all without one. ValueError for another mask."""
    mask = np.asarray(options.get("reset_mask", np.ones(count, bool)))
    if mask.dtype != bool or mask.shape != (count,) or not mask.any():
        raise ValueError(f"reset_mask={shown(mask)}: expected bool ({count},), one at least")
    if not begun and not mask.all():
        raise ValueError(f"reset_mask={shown(mask)}: the first reset is of all, leave it out")
    return mask


class CarRacingVector(gym.vector.VectorEnv):
    """`num_envs` cars, each with its own track.

    Args:
        num_envs: number of cars, 1 to 100,000.
        max_episode_steps: steps after which an episode is truncated.
        autoreset_mode: one of Gymnasium's `AutoresetMode`, or its value such as "NextStep".
            NEXT_STEP, the default: the step after an episode's end begins a new one and ignores
            the action. SAME_STEP: the new episode begins at once, and `info` has "final_obs" and
            "final_info". DISABLED: the caller resets with `options={"reset_mask": ...}`.
        bar: whether to draw the indicator bar.
        render_mode: None; a batch has no window.
        continuous, lap_complete_percent, domain_randomize: as Gymnasium's.
        observes, size, frame_skip, track: as of `CarRacing`.

    Raises:
        ValueError: as `CarRacing`.
        OSError: as `CarRacing`.

    Attributes:
        cars: the engine's `Cars`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int = MAX_FRAMES,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        bar: bool = True,
        render_mode: str | None = None,
        continuous: bool = True,
        lap_complete_percent: float = 0.95,
        domain_randomize: bool = False,
        observes: str = "picture",
        size: int = OBSERVATION_SIZE,
        frame_skip: int = 1,
        track: Checkpoints | None = None,
    ):
        num_envs = self.num_envs = whole_number("num_envs", num_envs, 1, MOST_CARS)
        self.max_episode_steps = whole_number("max_episode_steps", max_episode_steps, 1)
        self.render_mode = choice("render_mode", render_mode, (None,))
        self.autoreset_mode = check_autoreset(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        rules = (continuous, lap_complete_percent, domain_randomize)
        check_rules(*rules, bar)
        self.view, self.frame_skip = View(observes, size, bar), check_skip(frame_skip)
        self.single_observation_space = self.view.space
        self.single_action_space = action_space(continuous)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.cars = Cars(num_envs, "observation", bar, *rules, track)
        self._ended = np.ones(num_envs, bool)  # until the first reset
        self._begun = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict]:
        """Begin new episodes.

        Args:
            seed: of the tracks: one for each car, or n for n, n + 1, ...
            options: "reset_mask", bool (num_envs,), to reset only some cars; and "randomize", as
                for `CarRacing.reset`. The first reset is of all cars; ValueError for another mask.

        Returns:
            Observations, of `observation_space`, and {}.
        """
        self._check_open()
        options = check_options(options)
        mask = check_mask(options, self.num_envs, self._begun)
        whole = seeds_of(seed, self.num_envs)
        which = np.flatnonzero(mask)
        seeds = [one for one, asked in zip(whole, mask, strict=True) if asked]
        self.cars.reset(seeds, which, options.get("randomize", True))
        self._ended[which], self._begun = False, True
        return self.view.look(self.cars), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Drive all cars `frame_skip` frames; see Gymnasium's VectorEnv for what is returned.

        Raises:
            ValueError: actions of another shape, not finite, or not one of the five.
            ResetNeeded: before the first reset.
            RuntimeError: a car whose episode has ended must be reset first.
        """
        self._check_open()
        if not self._begun:
            raise ResetNeeded("no episode has begun: call reset before step")
        shape = self.action_space.shape
        actions = numbers("actions", actions, f"numbers of shape {shape}")
        if actions.shape != shape:
            raise ValueError(f"actions of shape {actions.shape}: expected {shape}, a car in a row")
        begin = np.flatnonzero(self._ended)
        if len(begin) and self.autoreset_mode != AutoresetMode.NEXT_STEP:
            raise RuntimeError(f"cars {begin.tolist()}: their episodes have ended, call reset")
        driving, rewards = np.flatnonzero(~self._ended), np.zeros(self.num_envs)
        terminated = np.zeros(self.num_envs, bool)
        rewards[driving], terminated[driving] = self.cars.step(actions[driving], driving)
        for _ in range(self.frame_skip - 1):
            driving = driving[~terminated[driving]]
            further, terminated[driving] = self.cars.step(actions[driving], driving)
            rewards[driving] += further
        self.cars.reset(which=begin)
        steps = -(-self.cars.cars["frames"] // self.frame_skip)
        truncated = steps >= self.max_episode_steps
        self._ended = terminated | truncated
        info = self._info(terminated)
        observations = self.view.look(self.cars)
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._ended.any():
            info = self._begin_again(observations, info)
        return observations, rewards, terminated, truncated, info

    @property  # type: ignore[misc]  # as SyncVectorEnv
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The random numbers of each car, as `SyncVectorEnv` gives them."""
        self._check_open()
        return tuple(self.cars.randoms)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The last seed of each car."""
        self._check_open()
        return tuple(self.cars.seeds)

    def close_extras(self, **kwargs) -> None:
        """Release the memory of the tracks."""
        self.view.close()
        self.cars = None  # type: ignore[assignment]  # closed

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError("this environment is closed: make another one")

    def _info(self, terminated: np.ndarray) -> dict:
        if not terminated.any():
            return {}
        finished = self.cars.cars["ending"] == physics.LAP_FINISHED
        return {"lap_finished": finished & terminated, "_lap_finished": terminated.copy()}

    def _begin_again(self, observations: np.ndarray, info: dict) -> dict:
        """Reset the ended cars in place; returns the info of this step."""
        ended = self._ended.copy()
        which, final = np.flatnonzero(ended), np.full(self.num_envs, None, object)
        for car in which:
            final[car] = observations[car].copy()
        self.cars.reset(which=which)
        observations[which] = self.view.look(self.cars, which)
        self._ended[:] = False
        return {
            "final_obs": final,
            "_final_obs": ended,
            "final_info": info,
            "_final_info": ended.copy(),
        }
