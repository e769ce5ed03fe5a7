"""A game of notebook 05: do two runs of each tell whether two variants differ?"""

import ipywidgets
import numpy as np
from matplotlib.figure import Figure

from stad_course.lesson import panel
from stad_lab.viz.plots import BLUE, GREEN, RED, describe, name_rows, new_figure
from stad_lab.viz.widgets import show

ANSWERS = ("one variant", "two variants")


def deal(scores: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, int]:
    """Two runs A and two runs B, (2, 2), and whether B has the other variant (0 or 1).

    They are points more than the mean of all four: their level would betray the variant.

    Args:
        scores: of each run of two variants, (2, runs), at least 4 runs. B has the other variant in
            half of all rounds; which one A has is chosen, too.
        rng: chooses the runs.
    """
    first, other = rng.integers(2, size=2)
    chosen = rng.choice(scores.shape[1], 4, replace=False)
    runs = np.array([scores[first, chosen[:2]], scores[first ^ other, chosen[2:]]])
    return runs - runs.mean(), int(other)


def best_rule(scores: np.ndarray, rounds: int = 20_000) -> tuple[float, float]:
    """The lead, in points, from which to bet on "two variants", and the share of rounds won."""
    rng = np.random.default_rng(0)
    dealt = [deal(scores, rng) for _ in range(rounds)]
    leads = np.abs([np.subtract(*runs.mean(axis=1)) for runs, _ in dealt])
    other = np.array([one for _, one in dealt], bool)
    limits = np.arange(0, 60)
    shares = [((leads >= limit) == other).mean() for limit in limits]
    best = int(np.argmax(shares))
    return float(limits[best]), float(shares[best])


def plot_deal(runs: np.ndarray, reach: float) -> Figure:
    """Two runs A and two runs B, with their means, on an axis of +-`reach`."""
    figure, ((axis,),) = new_figure(6.5, 1.7)
    for row, (pair, color) in enumerate(zip(runs, (BLUE, GREEN), strict=True)):
        axis.plot(pair, [row, row], "o", color=color, ms=9)
        axis.plot([pair.mean()] * 2, [row - 0.3, row + 0.3], color="black", lw=2)
    axis.set(xlim=(-reach, reach), xlabel="score of a run, minus the mean of all four")
    name_rows(axis, ["A", "B"])
    means = [f"{name} {pair.mean():+.0f}" for name, pair in zip("AB", runs, strict=True)]
    return describe(figure, "Two runs of each, and their means", "Means: ", means)


class TwoRuns(ipywidgets.VBox):
    """A bet in every round: do A and B have one variant, or two?

    Args:
        scores: of each run of two variants, (2, runs), at least 4 runs.
    """

    def __init__(self, scores: np.ndarray):
        self.scores, self.rng = scores, np.random.default_rng(0)
        self.won, self.rounds = 0, 0
        self.reach = float(np.ptp(scores))
        self.picture, self.told = ipywidgets.HTML(), ipywidgets.HTML()
        buttons = [ipywidgets.Button(description=answer) for answer in ANSWERS]
        for bet, button in enumerate(buttons):
            button.on_click(lambda _, bet=bet: self.bet(bet))
        super().__init__([self.picture, ipywidgets.HBox(buttons), self.told])
        self.next_round()

    def next_round(self) -> None:
        """Deal two runs of each, and show them."""
        self.runs, self.other = deal(self.scores, self.rng)
        self.picture.value = show(plot_deal(self.runs, self.reach)).data

    def bet(self, bet: int) -> None:
        """Compare a bet (0: one variant, 1: two variants) with the truth, and deal again."""
        right = bet == self.other
        self.won, self.rounds = self.won + right, self.rounds + 1
        lead, word = abs(np.subtract(*self.runs.mean(axis=1))), "Right" if right else "Wrong"
        truth = f"{word}: {ANSWERS[self.other]}. The means differed by {lead:.0f} points."
        score = f"{self.won} of {self.rounds} bets won; a coin wins half."
        self.told.value = panel(GREEN if right else RED, truth, score).data
        self.next_round()

    def _repr_mimebundle_(self, **kwargs) -> dict:
        """The game, and for pages without a kernel its first round."""
        question = "One variant, or two? Run the notebook to bet."
        fallback = self.picture.value + panel(BLUE, question).data
        return super()._repr_mimebundle_(**kwargs) | {"text/html": fallback}
