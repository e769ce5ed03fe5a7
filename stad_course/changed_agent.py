"""An agent whose actions are changed before the car gets them, for notebook 06."""

from collections.abc import Callable

import numpy as np

from stad_lab.agent import Agent
from stad_lab.envs.cars import Cars

Change = Callable[[np.ndarray, np.ndarray], np.ndarray]


class ChangedAgent:
    """A driver for `rollout`: an agent whose actions `change` replaces.

    Args:
        agent: at the start of its episodes.
        cars: those it drives.
        change: actions (cars, 3) and speeds (cars,), world units a second -> actions (cars, 3).
    """

    def __init__(self, agent: Agent, cars: Cars, change: Change):
        self.agent, self.cars, self.change = agent, cars, change
        self.reset, self.keep = agent.reset, agent.keep

    def act_batch(self, seen: np.ndarray) -> np.ndarray:
        """The changed actions of the present cars, float32 (cars, 3)."""
        before, actions = self.agent.state, self.agent.act_batch(seen).copy()
        velocity = self.cars.cars["velocity"][self.agent.cars, 0, :2]
        actions = self.change(actions, np.linalg.norm(velocity, axis=1)).astype(np.float32)
        self.agent.remember(actions, before)  # M is told what the car really does
        return actions
