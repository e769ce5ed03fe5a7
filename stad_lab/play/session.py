"""Play: a session at the wheel, on the real track or in the dream, where hand and agent change places at any frame.

A session has no clock and no window: whoever calls `step` sets the pace (`play_widget`, a script, a test). On the real
track the agent looks at every frame and M remembers every action, also while the hand drives; so the agent can take the
wheel at any moment as if it had driven all along, and a dream can begin with the very frame that is on the screen.
"""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

from stad_lab.agent import Agent
from stad_lab.envs.car_racing import make_env
from stad_lab.envs.dream import DreamEnv
from stad_lab.evaluation.trajectories import Drive, to_drive, true_motion
from stad_lab.models.controller import control
from stad_lab.training.dataset import TRACK_RANGES

WORLDS = ("real", "dream")
DRIVERS = ("hand", "agent")
KEYS = {  # the browser's names of keys, by their place on the keyboard -> what they do
    **{"ArrowLeft": "left", "ArrowRight": "right", "ArrowUp": "gas", "ArrowDown": "brake"},
    **{"KeyA": "left", "KeyD": "right", "KeyW": "gas", "KeyS": "brake", "Space": "brake"},
}
PEDALS = ("left", "right", "gas", "brake")
FULL = np.array([1.0, 0.7, 0.8])  # steering, gas and brake of a key held for long
PRESS = np.array([0.08, 0.04, 0.1])  # how far a held key moves each in a frame
RELEASE = np.array([0.16, 0.08, 0.4])  # and how far a released one lets it fall back


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch on one thread: for a single frame a second one only costs time, and on a busy machine very much of it."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class Hand:
    """A hand on the keyboard: keys are down or up, the action that they make is smooth.

    Attributes:
        held: which of PEDALS are down.
        action: the last action, float32 (3,): steering in [-1, 1], gas in [0, 0.7], brake in [0, 0.8]; taken over from
            an agent, gas and brake may begin with up to 1.
    """

    def __init__(self):
        self.held: set[str] = set()
        self.action = np.zeros(3, np.float32)

    def hold(self, *pedals: str) -> None:
        """Hold these, of "left", "right", "gas" and "brake", and let go of all others. ValueError for another name."""
        for pedal in pedals:
            if pedal not in PEDALS:
                raise ValueError(f"pedal {pedal!r}: expected some of {', '.join(PEDALS)}")
        self.held = set(pedals)

    def act(self) -> np.ndarray:
        """The next action, float32 (3,), one small move from the last one towards what the held keys want."""
        left, right, gas, brake = (pedal in self.held for pedal in PEDALS)
        wanted = np.array([right - left, gas, brake]) * FULL
        towards = (np.abs(wanted) > np.abs(self.action)) | (wanted * self.action < 0)
        step = np.where(towards, PRESS, RELEASE)
        self.action = (self.action + np.clip(wanted - self.action, -step, step)).astype(np.float32)
        return self.action.copy()


@dataclass(frozen=True)
class Dreamt:
    """What was driven in the dream: T frames; row t belongs to the moment at which `frames[t]` is seen."""

    frames: np.ndarray
    """What V draws of z: uint8 (T, 64, 64, 3)."""
    latents: np.ndarray
    """z: float32 (T, latent_size)."""
    actions: np.ndarray
    """What the driver did: float32 (T, 3)."""
    by_hand: np.ndarray
    """Whether the hand drove: bool (T,)."""


class Session:
    """One seat, two worlds, two drivers.

    Attributes:
        world: "real" or "dream"; change it with `enter`.
        driver: "hand" or "agent"; change it with `give`.
        hand: whose `held` keys drive while the driver is "hand".
        dream: the DreamEnv that is driven in the dream; its `temperature` may be set.
        track: seed of the present track.
        score: return of the real episode so far.
        earlier: the last four episodes before this one, as (track, Drive), newest last.

    Args:
        agent: the trained agent; the session drives with it, so give it one of its own.
        track: seed of the first track.
    """

    def __init__(self, agent: Agent, track: int = 1):
        self.agent, self.hand, self.driver = agent, Hand(), "hand"
        self.env = make_env()
        self.dream = DreamEnv(agent.autoencoder, agent.mdn_rnn, render_mode="rgb_array")
        self.earlier: deque[tuple[int, Drive]] = deque(maxlen=4)
        self.rows: list[tuple] = []
        self.begin(track)

    @one_thread()
    def begin(self, track: int) -> None:
        """Start an episode on a real track; the one before is kept in `earlier`.

        Raises:
            ValueError: a track that is not a whole number from 0 to 999,999.
        """
        low, high = TRACK_RANGES["test"]
        if not isinstance(track, int | np.integer) or not low <= track < high:
            raise ValueError(f"track={track!r}: expected a whole number from {low} to {high - 1:,}")
        if self.rows:
            self.earlier.append((self.track, self.drive()))
        self.track, self.score, self.rows, self.dream_rows, self.drivers = (
            int(track),
            0.0,
            [],
            [],
            [],
        )
        self.world, self.real_ended, self.dream_ended = "real", False, False
        self.hand.action = np.zeros(3, np.float32)
        self.observation, _ = self.env.reset(seed=self.track)
        self.agent.reset()
        self._look()

    @property
    def ended(self) -> bool:
        """Whether the episode of the present world is over; `begin` another, or `enter` the other world."""
        return self.real_ended if self.world == "real" else self.dream_ended

    def give(self, driver: str) -> None:
        """Put "hand" or "agent" at the wheel; a hand begins with what the agent did last. ValueError for others."""
        if driver not in DRIVERS:
            raise ValueError(f"driver {driver!r}: expected one of {', '.join(DRIVERS)}")
        self.driver = driver

    @one_thread()
    def enter(self, world: str) -> None:
        """Go on in the "real" world where it stands, or in a new "dream" of the frame that it shows now.

        Raises:
            ValueError: another world.
        """
        if world not in WORLDS:
            raise ValueError(f"world {world!r}: expected one of {', '.join(WORLDS)}")
        if world == "dream":
            options = {"latents": self.agent.latents[0], "state": self.before}
            self.latents, info = self.dream.reset(seed=self.track, options=options)
            self.hidden, self.dream_rows, self.dream_ended = info["hidden"], [], False
        self.world = world

    @one_thread()
    def step(self) -> None:
        """Drive one frame on, in the present world, with the present driver.

        Raises:
            RuntimeError: the episode has ended.
        """
        if self.ended:
            raise RuntimeError(
                "the episode has ended: begin(track) another, or enter(world) the other world"
            )
        if self.world == "real":
            self._step_real()
        else:
            self._step_dream()

    @one_thread()
    def picture(self) -> np.ndarray:
        """What the driver sees now: the observation, uint8 (96, 96, 3), or in the dream what V draws, (64, 64, 3)."""
        return self.observation if self.world == "real" else self.dream.render()

    def drive(self) -> Drive:
        """The real episode so far. Raises ValueError if nothing was driven yet."""
        return to_drive(self.rows)

    def by_hand(self) -> np.ndarray:
        """Which frames of the real episode the hand drove: bool (T,). While a seat drives, it grows."""
        return np.array([driver == "hand" for driver in self.drivers], bool)

    def dreamt(self) -> Dreamt:
        """The present dream, or the last one on this track. Raises ValueError if nothing was driven in one."""
        if not self.dream_rows:
            raise ValueError(
                "nothing was driven in a dream on this track: enter('dream') and drive there first"
            )
        frames, latents, actions, by_hand = (
            np.array(part) for part in zip(*self.dream_rows, strict=True)
        )
        return Dreamt(frames, latents, actions, by_hand)

    def _step_real(self) -> None:
        driver = self.driver  # once: `give` may come from another thread in between
        action, motion = self._act(driver, self.proposed), true_motion(self.env)
        if driver == "hand":  # M remembered what the agent would have done: tell it what was done
            self.agent.take_in(action[None], self.before)
        following, reward, terminated, truncated, _ = self.env.step(action)
        self.drivers.append(
            driver
        )  # first: who reads `drive` and then `by_hand` meanwhile has all of the latter
        self.rows.append((self.observation, action, reward, motion))
        self.observation, self.score = following, self.score + reward
        self.real_ended = terminated or truncated
        self._look()

    def _step_dream(self) -> None:
        driver, seen = self.driver, np.concatenate([self.latents, self.hidden])
        action = self._act(driver, control(self.agent.parameters, seen[None])[0])
        self.dream_rows.append((self.dream.render(), self.latents, action, driver == "hand"))
        self.latents, _, _, self.dream_ended, info = self.dream.step(action)
        self.hidden = info["hidden"]

    def _act(self, driver: str, proposed: np.ndarray) -> np.ndarray:
        if driver == "agent":
            self.hand.action = proposed.copy()
        return proposed if driver == "agent" else self.hand.act()

    def _look(self) -> None:
        """Show the agent the present observation, and keep M's memory from before it."""
        self.before = self.agent.state
        self.proposed = self.agent.act(self.observation)
