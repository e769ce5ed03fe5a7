"""The rows of the replication's table: a variant, a recipe and some seeds each.

`stad_lab.replication.run` makes them, and `stad_lab.replication.tables` says what came out.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from stad_lab.config import Settings
from stad_lab.models.vae import VARIANTS
from stad_lab.training.fine_tuning import FINISH

FLOORS = {  # rows of drivers that do not look at the road
    "random_driver": "smooth random steering and gas, as for the rollouts",
    "gentle_driver": "straight on with little gas, as the first agent that evolution tries",
}
EARLY = (0, 1, 2, 3, 4)  # seeds of the rows whose runs are short, and whose scores scatter the most
NO_BAR_SEEDS = (0, 1)


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    variant: str
    about: str
    """What is special about it, for the reader."""
    settings: Settings
    """Of the only round, of the second, or of the finish."""
    first: Settings | None = None
    """Of the first round, in a recipe of two."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the searches for C. V and M, and a first round, are made once."""
    world: str | None = None
    """Name of the row whose rollouts, V and M it shares; None for its own."""
    base: str | None = None
    """Name of the row whose searches it goes on from, seed by seed, with a finish."""
    retrained: bool = False
    """Whether each seed is a whole run, with rollouts, V and M of its own."""

    def settings_of(self, seed: int) -> Settings:
        """The settings of one of its seeds."""
        return dataclasses.replace(
            self.settings, evolution_seed=seed, seed=seed if self.retrained else self.settings.seed
        )


def make_rows() -> dict[str, Row]:
    """All rows of the table by name."""
    rows = {}
    for variant in VARIANTS:
        rows[f"paper_{variant}"] = Row(variant, "the paper's recipe", Settings.preset("paper"))
    # 900 + 55 x 64 + 11 x 16: 4,596 episodes.
    one = Settings.preset("laptop", crop_bar=False)
    # 900 + 15 x 64 + 3 x 16 episodes in the first round, 110 + 40 x 64 + 8 x 16 in the second: 4,706 in all.
    first = dataclasses.replace(one, generations=15)
    second = dataclasses.replace(
        first, agent_episodes=110, generations=40, sigma=0.05, revisited_share=0.5
    )
    for variant in VARIANTS:
        rows[f"two_rounds_{variant}"] = Row(variant, "our recipe", second, first)
    # Before the ceiling: 900 + 15 x 64 + 3 x 16 = 1,908 episodes.
    for variant in VARIANTS:
        rows[f"early_{variant}"] = Row(
            variant, "the first round of our recipe", first, seeds=EARLY, retrained=True
        )
    # 15 x 256 + 3 x 16 episodes more, and 480 agents: 8,594 episodes and 4,000 agents in all.
    finished = dataclasses.replace(second, **FINISH)
    for variant in VARIANTS:
        base = f"two_rounds_{variant}"
        rows[f"finished_{variant}"] = Row(variant, "our recipe and a finish", finished, base=base)
    longer = dataclasses.replace(second, generations=160, sigma_decay=0.99)
    rows["long_input"] = Row(
        "input", "our recipe, four times as long", longer, first, (0,), "two_rounds_input"
    )
    never_back = dataclasses.replace(second, revisited_share=0.0)
    rows["two_rounds_new_tracks"] = Row(
        "input", "our recipe, new tracks alone", never_back, first, seeds=(0,)
    )
    before = [dataclasses.replace(settings, **BEFORE) for settings in (second, first)]
    rows["two_rounds_few_agents"] = Row(
        "input", "our recipe before it was improved", *before, seeds=(0,)
    )
    rows["one_round"] = Row("input", "one round", one)
    for name, (about, changes, world) in ABLATIONS.items():
        settings = dataclasses.replace(rows[world or "one_round"].settings, **changes)
        rows[name] = Row("input", about, settings, seeds=(0,), world=world)
    # What counts there is the luck of V, so each seed has its own.
    rows["no_bar"] = dataclasses.replace(rows["no_bar"], seeds=NO_BAR_SEEDS, retrained=True)
    for variant, what in NO_BAR.items():
        about = f"{rows['no_bar'].about}, {what}"
        rows[f"no_bar_{variant}"] = dataclasses.replace(
            rows["no_bar"], variant=variant, about=about
        )
    return rows


# Our recipe before it was improved.
BEFORE = {
    "population": 16,
    "tracks": 4,
    "revisited_share": 0.0,
    "components": 0,
    "sigma_decay": 0.0,
    "crop_bar": True,
}
# Name -> what it is, the change, and the row that it changes and whose V and M it shares; None for "one_round" with a
# V and an M of its own. V and M of "one_round" come from a kind of processor that not everybody has, and without them
# a row could be compared with nothing: so "another_V" is the same recipe, made where the rows that share it are made.
ABLATIONS = {
    "no_M": ("one round, C sees z alone", {"features": "z"}, "one_round"),
    "no_z": ("one round, C sees h alone", {"features": "h"}, "one_round"),
    "untrained_M": ("one round, M's weights are random", {"m_steps": 0}, "one_round"),
    "few_agents": (
        "one round, 16 agents on 4 tracks each",
        {"population": 16, "tracks": 4},
        "one_round",
    ),
    "another_V": ("one round, all of it from another seed", {"seed": 1}, None),
    "last_mean": ("one round, the last CMA mean alone", {"averaged_share": 0.0}, "another_V"),
    "every_weight": ("one round, every weight of C searched", {"components": 0}, "another_V"),
    "own_sigma": ("one round, CMA-ES's own step size", {"sigma_decay": 0.0}, "another_V"),
    "no_bar": (
        "one round, the indicator bar cut off: the laptop settings",
        {"crop_bar": True},
        None,
    ),
    **{f"stride_{k}": (f"one round, stride {k}", {"stride": k}, None) for k in (1, 2, 8)},
    **{f"latent_{n}": (f"one round, {n} latents", {"latent_size": n}, None) for n in (16, 64)},
}
# Variant of the "no_bar" recipe -> what V does with the difference image. With `input`, as "no_bar" is, it sees it.
NO_BAR = {
    "frame": "and no difference images",
    "output": "and the difference image redrawn, not seen",
    "input_output": "and the difference image seen and redrawn",
}
ROWS = make_rows()


def is_floor(name: str, seeds: Sequence[int] | None = None) -> bool:
    """Whether a row is one of FLOORS. Raises ValueError if seeds are wanted of one, since it has none."""
    if name in FLOORS and seeds:
        raise ValueError(f"row {name!r} is no search and has no seeds: leave them out")
    return name in FLOORS


def find_row(name: str, seeds: Sequence[int] | None = None) -> Row:
    """The row of a name, if wanted with some of its seeds alone. Raises ValueError if there is no such row or seed."""
    if name not in ROWS:
        raise ValueError(f"unknown row {name!r}: choose one of {', '.join([*ROWS, *FLOORS])}")
    row = ROWS[name]
    for seed in seeds or ():
        if seed not in row.seeds:
            raise ValueError(
                f"row {name!r} has no seed {seed}: choose of {', '.join(map(str, row.seeds))}"
            )
    return dataclasses.replace(row, seeds=tuple(dict.fromkeys(seeds))) if seeds else row
