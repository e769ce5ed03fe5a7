"""CarRacing-v3 as a Gymnasium environment on our engine, for one car.

Returns, rewards and endings are those of Gymnasium's own CarRacing-v3, bit for bit on Linux x86-64,
elsewhere until rounding errors grow; the observation differs by less than 0.3 of 255 on average, in
the usual colours. To drive many cars at once, see `envs.vector`.
"""

import inspect
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.box2d import car_dynamics
from gymnasium.envs.box2d import car_racing as reference

from stad_lab.envs import physics
from stad_lab.envs.arguments import check_options, choice, numbers, shown, whole_number
from stad_lab.envs.cars import Cars, check_rules, pose_on
from stad_lab.envs.frames import OBSERVATION_SIZE
from stad_lab.envs.own_track import Checkpoints
from stad_lab.envs.views import View
from stad_lab.envs.window import Window

MAX_FRAMES = 1000  # Gymnasium's time limit for CarRacing, in frames
FAST_ID = "StadLab/CarRacing-v3"
RENDER_MODES = ("human", "rgb_array", "state_pixels")


def make_env(fast: bool = True, **kwargs) -> gym.Env:
    """Make a CarRacing-v3 environment.

    Args:
        fast: True for our engine (`CarRacing`), False for Gymnasium's own CarRacing-v3 as it is.
        **kwargs: passed to `gymnasium.make`, for example `render_mode="rgb_array"`, or, for our
            engine only, the options of `CarRacing`, such as `bar=False`.

    Returns:
        An environment. If no option says otherwise, observations are uint8 (96, 96, 3) and actions
        float32 (3,): steering in [-1, 1], gas and brake in [0, 1]. An episode has at most 1,000
        steps.

    Raises:
        ValueError: an option that the environment does not have, or another value of it.
    """
    if not isinstance(fast, bool | np.bool_):
        raise ValueError(f"fast={shown(fast)}: expected True or False")
    signature = inspect.signature(CarRacing if fast else reference.CarRacing)
    known = [*signature.parameters, "max_episode_steps", "disable_env_checker"]
    if unknown := [name for name in kwargs if name not in known]:
        raise ValueError(
            f"make_env: unknown {', '.join(unknown)}; choose from {', '.join(known)}. The seed of"
            " a track belongs to reset: env.reset(seed=1)"
        )
    rules = ("continuous", "lap_complete_percent", "domain_randomize", "bar")
    check_rules(**{name: kwargs[name] for name in rules if name in kwargs})
    choice("render_mode", kwargs.get("render_mode"), (None, *RENDER_MODES))
    if (steps := kwargs.get("max_episode_steps")) is not None:  # -1 is no limit, for Gymnasium
        kwargs["max_episode_steps"] = whole_number("max_episode_steps", steps, -1)
    return gym.make(FAST_ID if fast else "CarRacing-v3", **kwargs)


def place_car(
    env: gym.Env, tile: int, speed: float = 0.0, turn: float = 0.0, offset: float = 0.0
) -> np.ndarray:
    """Put the car on a tile of its track, moving; returns the observation there.

    Args:
        env: from `make_env`, fast or not, after a `reset`.
        tile, speed, turn, offset: as for `Cars.place`.
    """
    racing: Any = env.unwrapped
    if isinstance(racing, CarRacing):
        return racing.place(tile, speed=speed, turn=turn, offset=offset)
    heading, x, y = pose_on(racing.track, tile, turn, offset)
    racing.car.destroy()
    racing.car = car_dynamics.Car(racing.world, heading, x, y)
    for wheel, (left, ahead) in zip(racing.car.wheels, car_dynamics.WHEELPOS, strict=True):
        # Gymnasium places the wheels as if the car faced north.
        corner = left * car_dynamics.SIZE, ahead * car_dynamics.SIZE
        wheel.position = racing.car.hull.GetWorldPoint(corner)
        wheel.omega = speed / wheel.wheel_rad
    for body in racing.car.drawlist:
        body.linearVelocity = (-np.sin(heading) * speed, np.cos(heading) * speed)
    racing.t = max(racing.t, 1.0)  # the opening zoom is over
    return racing._render("state_pixels")


def action_space(continuous: bool = True) -> gym.Space:
    """The action space of one car, as Gymnasium's."""
    if not continuous:
        return gym.spaces.Discrete(5)
    low, high = np.array([-1, 0, 0], np.float32), np.ones(3, np.float32)
    return gym.spaces.Box(low, high)


def check_skip(frame_skip: int) -> int:
    """The number of frames of a step. ValueError if it is not a whole number from 1 to 1,000."""
    return whole_number("frame_skip", frame_skip, 1, MAX_FRAMES)


class CarRacing(gym.Env, gym.utils.EzPickle):
    """CarRacing-v3 for one car.

    Args:
        render_mode: of `render()`, "human", "rgb_array" or "state_pixels": the window of
            Gymnasium, without skid marks; or None.
        bar: whether to draw the indicator bar. Without it the lowest 12 of 96 rows are black.
        continuous, lap_complete_percent, domain_randomize: as Gymnasium's.
        observes: "picture"; "state", float32 (10,), see `envs.state.STATE`; or "above", the whole
            track and the car from above.
        size: of a picture, pixels, 32 to 512. Our engine draws 96, Gymnasium's slower code others.
        frame_skip: frames that a step repeats its action for, 1 to 1,000; only the last is drawn.
            Gymnasium limits an episode by steps: give `max_episode_steps` of `make`, too.
        track: checkpoints of your own track, see `envs.own_track`; None for the track of a seed.

    Raises:
        ValueError: an option with a value that it does not take.
        OSError: the file of `track` cannot be read.

    Attributes:
        cars: the engine's `Cars`, with this car as number 0.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        bar: bool = True,
        continuous: bool = True,
        lap_complete_percent: float = 0.95,
        domain_randomize: bool = False,
        observes: str = "picture",
        size: int = OBSERVATION_SIZE,
        frame_skip: int = 1,
        track: Checkpoints | None = None,
    ):
        rules = (continuous, lap_complete_percent, domain_randomize)
        added = (observes, size, frame_skip, track)
        gym.utils.EzPickle.__init__(self, render_mode, bar, *rules, *added)
        self.render_mode = choice("render_mode", render_mode, (None, *RENDER_MODES))
        self.continuous = continuous
        self.view, self.frame_skip = View(observes, size, bar), check_skip(frame_skip)
        self.observation_space, self.action_space = self.view.space, action_space(continuous)
        self.cars = Cars(1, "observation", bar, *rules, track)
        self._window: Window | None = None
        self._started = False

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict]:
        """Begin an episode on the track of `seed`; returns the observation and {}.

        Without a seed the random numbers go on. With `domain_randomize`,
        `options={"randomize": False}` keeps the colours. RuntimeError after `close`.
        """
        self._check_open()
        super().reset(seed=seed)
        self.cars.randoms[0], self.cars.seeds[0] = self.np_random, self.np_random_seed
        self.cars.reset(randomize=check_options(options).get("randomize", True))
        self._started = True
        self._show()
        return self.view.look(self.cars)[0], {}

    def step(self, action: np.ndarray | int) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Drive `frame_skip` frames: (observation, their reward, terminated, False, info).

        If it has terminated, `info["lap_finished"]` says whether the lap is complete.

        Raises:
            ValueError: an action that is not three finite numbers, or not one of the five.
            RuntimeError: called before `reset`, or after `close`.
        """
        self._check_begun("step")
        actions = numbers("action", action, "numbers")[None]
        rewards, ended = self.cars.step(actions)
        for _ in range(self.frame_skip - 1):
            if not ended[0]:
                further, ended = self.cars.step(actions)
                rewards += further
        ending = self.cars.cars["ending"][0]
        info = {"lap_finished": bool(ending == physics.LAP_FINISHED)} if ended[0] else {}
        self._show()
        seen = self.view.look(self.cars)[0]
        return seen, float(rewards[0]), bool(ended[0]), False, info

    @property
    def track(self) -> np.ndarray:
        """The centre line, float64 (tiles, 4): angle from the origin, heading, x and y."""
        self._check_begun("track")
        return self.cars.tracks[0].path

    def place(self, tile: int, *how: float, **named: float) -> np.ndarray:
        """Put the car on a tile, as `Cars.place`; returns the observation there."""
        self._check_begun("place")
        self.cars.place(0, tile, *how, **named)
        return self.view.look(self.cars)[0]

    def render(self) -> np.ndarray | None:
        """Gymnasium's window: uint8 (400, 600, 3), "state_pixels" (96, 96, 3); None for "human"."""
        self._check_begun("render")
        if self.render_mode is None:
            gym.logger.warn("render() without a render_mode: give one to make(...)")
            return None
        if self._window is None:
            self._window = Window(self.render_mode)
        return self._window.draw(self.cars)

    def close(self) -> None:
        """Release the window and the memory of the track."""
        if self._window is not None:
            self._window.close()
        self.view.close()
        self._window = None
        self.cars = None  # type: ignore[assignment]  # closed

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()

    def _check_begun(self, what: str) -> None:
        self._check_open()
        if not self._started:  # a copy begins like a new environment
            raise RuntimeError(f"{what} before reset: call reset() to begin an episode")

    def _check_open(self) -> None:
        if self.cars is None:
            raise RuntimeError("the environment is closed: make a new one")
