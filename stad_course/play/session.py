"""A session at the wheel: on the real track or in the dream, driven by keys or by the agent.

It has no clock and no window: the caller sets the pace with `step`. On the real track the agent
sees every frame and M remembers every action, also while the human drives. So the agent can take
over at any frame, and a dream can begin at any frame.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

from stad_lab.agent import Agent
from stad_lab.config import TRACK_RANGES
from stad_lab.dreaming import Dreamer
from stad_lab.envs.arguments import choice
from stad_lab.envs.car_racing import CarRacing, make_env
from stad_lab.envs.dream import DreamEnv
from stad_lab.evaluation.trajectories import Trajectory, true_motion
from stad_lab.models.mdn_rnn import to_state

WORLDS, DRIVERS = ("real", "dream"), ("hand", "agent")
PEDALS = ("left", "right", "gas", "brake")
FULL = np.array([1.0, 0.7, 0.8])  # steering, gas and brake of a key held for long
PRESS = np.array([0.08, 0.04, 0.1])  # change of each in a frame, towards a held key's value
RELEASE = np.array([0.16, 0.08, 0.4])  # and back, after its release
LAST_TRACK = TRACK_RANGES["test"][1] - 1  # of the tracks that nothing is trained on


@contextmanager
def on_one_thread() -> Iterator[None]:
    """PyTorch on one thread: for a single frame, more threads cost time."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def pose_of(car: np.ndarray) -> tuple[float, float, float]:
    """Position (world units) and heading (radians) of the hull of a `physics.CAR`."""
    return (*car["position"][0].tolist(), float(car["angle"][0]))


class Hand:
    """Keys as a driver. Keys are binary and steering is continuous, so the action is smoothed."""

    def __init__(self):
        self.held: set[str] = set()  # which of PEDALS are down
        self.action = np.zeros(3, np.float32)  # the last one, which may be an agent's

    def hold(self, *pedals: str) -> None:
        """Hold these of PEDALS and release all others. ValueError for another name."""
        for pedal in pedals:
            choice("pedal", pedal, PEDALS)
        self.held = set(pedals)

    def act(self) -> np.ndarray:
        """The next action, float32 (3,): one small change from the last one."""
        left, right, gas, brake = (pedal in self.held for pedal in PEDALS)
        wanted = np.array([right - left, gas, brake]) * FULL
        towards = (np.abs(wanted) > np.abs(self.action)) | (wanted * self.action < 0)
        step = np.where(towards, PRESS, RELEASE)
        self.action = (self.action + np.clip(wanted - self.action, -step, step)).astype(np.float32)
        return self.action.copy()


@dataclass(frozen=True)
class DreamTrajectory:
    """T frames of a dream: what V decodes, z, the action on it, and whether the human drove."""

    frames: np.ndarray  # uint8 (T, 64, 64, 3)
    latents: np.ndarray  # float32 (T, latent_size)
    actions: np.ndarray  # float32 (T, 3)
    by_hand: np.ndarray  # bool (T,)


class Session:
    """One car, two worlds (the real track and the dream), two drivers (human and agent).

    Attributes:
        world: "real" or "dream"; change it with `enter`.
        driver: "hand" or "agent"; change it with `give`.
        hand: whose `held` keys drive while the driver is "hand".
        dream: the DreamEnv; its `temperature` may be set.
        track: seed of the present track.
        score: return of the real episode so far.
        best: of each track, the highest score of a whole episode that the human alone drove.

    The session changes the memory of its agent, so give it one of its own.
    """

    def __init__(self, agent: Agent, track: int = 1):
        self.agent, self.hand, self.driver = agent, Hand(), "hand"
        self.env = make_env()
        racing = self.env.unwrapped
        assert isinstance(racing, CarRacing)
        self.racing = racing
        self.dream = DreamEnv(agent.vae, agent.mdn_rnn, render_mode="rgb_array")
        self.dreamer = Dreamer(self.dream, agent.parameters)
        self.rows: list[tuple] = []
        self.dream_rows: list[tuple] = []
        self.drivers: list[str] = []
        self.poses: list[tuple] = []
        self.best: dict[int, float] = {}
        self.begin(track)

    @on_one_thread()
    def begin(self, track: int) -> None:
        """Begin an episode on a real track (ValueError for others than 0 to 999,999)."""
        if not isinstance(track, int | np.integer) or not 0 <= track <= LAST_TRACK:
            raise ValueError(f"track={track!r}: expected a whole number from 0 to {LAST_TRACK:,}")
        self.track, self.score, self.world = int(track), 0.0, "real"
        self.rows, self.dream_rows, self.drivers, self.poses = [], [], [], []
        self.real_ended, self.dream_ended = False, False
        self.hand.action = np.zeros(3, np.float32)
        self.observation, _ = self.env.reset(seed=self.track)
        self.agent.reset()
        self._observe()

    @property
    def ended(self) -> bool:
        """Whether the present world's episode is over: `begin` another, or `enter` the other."""
        return self.real_ended if self.world == "real" else self.dream_ended

    @property
    def car(self) -> np.ndarray:
        """The real car's state, a record of `physics.CAR`."""
        return self.racing.cars.cars[0]

    @property
    def road(self) -> np.ndarray:
        """Centres of the track's tiles from above, world units, float64 (tiles, 2)."""
        return self.racing.track[:, 2:]

    def path(self) -> np.ndarray:
        """Where the real car was in each frame so far, world units, float64 (T, 2)."""
        return np.array(self.poses).reshape(-1, 3)[:, :2]

    def give(self, driver: str) -> None:
        """Let "hand" or "agent" drive (ValueError for others), from the last action on."""
        choice("driver", driver, DRIVERS)
        self.driver = driver

    @on_one_thread()
    def enter(self, world: str) -> None:
        """Continue on the "real" track, or in a new "dream" of its frame; else ValueError."""
        choice("world", world, WORLDS)
        if world == "dream":
            options = {"latents": self.agent.latents[0], "state": to_state(self.before)}
            self.latents, _ = self.dream.reset(seed=self.track, options=options)
            self.dream_rows, self.dream_ended = [], False
        self.world = world

    @on_one_thread()
    def step(self) -> None:
        """Drive one frame in the present world. RuntimeError if its episode has ended."""
        if self.ended:
            raise RuntimeError("the episode has ended: begin(track), or enter the other world")
        driver = self.driver  # read once: another thread may call `give`
        (self._step_real if self.world == "real" else self._step_dream)(driver)

    @on_one_thread()
    def picture(self) -> np.ndarray:
        """What the driver sees: the observation, uint8 (96, 96, 3), or a decoded z, (64, 64, 3)."""
        decoded = self.dream.render() if self.world == "dream" else None
        return self.observation if decoded is None else decoded

    def trajectory(self) -> Trajectory:
        """The real episode so far. ValueError if nothing was driven yet."""
        if not self.rows:
            raise ValueError("nothing was driven on this track: drive at least one frame first")
        observations, actions, rewards, motion = map(np.array, zip(*self.rows, strict=True))
        return Trajectory(observations, actions, rewards.astype(np.float32), motion)

    def by_hand(self) -> np.ndarray:
        """Which frames of the real episode the human drove: bool (T,)."""
        return np.array([driver == "hand" for driver in self.drivers], bool)

    def dream_trajectory(self) -> DreamTrajectory:
        """The last dream on this track. ValueError if nothing was driven in one."""
        if not self.dream_rows:
            raise ValueError("nothing was driven in a dream on this track: enter('dream') first")
        return DreamTrajectory(*map(np.array, zip(*self.dream_rows, strict=True)))

    def _step_real(self, driver: str) -> None:
        action, motion = self._act(driver, self.proposed), true_motion(self.racing.cars)
        if driver == "hand":  # M remembered the agent's action: replace it by the human's
            self.agent.remember(action[None], self.before)
        pose = pose_of(self.car)
        following, reward, terminated, truncated, _ = self.env.step(action)
        # Drivers first: who reads `trajectory` and then `by_hand` meanwhile finds all of them.
        self.drivers.append(driver)
        self.poses.append(pose)
        self.rows.append((self.observation, action, reward, motion))
        self.observation, self.score = following, self.score + float(reward)
        self.real_ended = terminated or truncated
        if self.real_ended and set(self.drivers) == {"hand"}:
            self.best[self.track] = max(self.score, self.best.get(self.track, self.score))
        self._observe()

    def _step_dream(self, driver: str) -> None:
        action = self._act(driver, self.dreamer.act_batch([self.latents])[0])
        self.dream_rows.append((self.dream.render(), self.latents, action, driver == "hand"))
        self.latents, _, _, self.dream_ended, _ = self.dream.step(action)

    def _act(self, driver: str, proposed: np.ndarray) -> np.ndarray:
        if driver == "hand":
            return self.hand.act()
        self.hand.action = proposed.copy()
        return proposed

    def _observe(self) -> None:
        """Show the agent the present observation, and keep M's memory from before it."""
        self.before = self.agent.state
        self.proposed = self.agent.act(self.observation)
