"""Baseline: random steering, gas and brake in every frame."""

import numpy as np


class RandomAgent:
    """Uniform actions."""

    def reset(self):
        """Every episode repeats the same random numbers."""
        self.random = np.random.default_rng(0)

    def act(self, observation):
        """It does not look."""
        return self.random.uniform([-1, 0, 0], [1, 1, 1])


def make_agent():
    """As every submission."""
    return RandomAgent()
