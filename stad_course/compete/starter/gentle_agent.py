"""Baseline: straight on, with a little gas in every frame."""


class GentleAgent:
    """A constant action."""

    def act(self, observation):
        """It does not look."""
        return [0.0, 0.05, 0.0]


def make_agent():
    """As every submission."""
    return GentleAgent()
