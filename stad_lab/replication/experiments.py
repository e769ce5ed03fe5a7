"""The experiments of the replication: a variant, a configuration and some seeds each.

`stad_lab.replication.run` carries them out; `stad_lab.replication.claims` says what came of them.
All of them were run with pycma 4.5, which adapts sigma by two points (TPA) from 300 searched
dimensions on and by cumulative path length (CSA) below. The configurations say which.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from stad_lab.config import VARIANTS, Config

BASELINE_DRIVERS = {  # drivers that do not see the road, and have no seeds
    "random_driver": "smooth random steering and gas, as in the dataset",
    "constant_driver": "straight on with little gas, as the first controller of CMA-ES",
}
RECIPES = {  # experiments RECIPE_VARIANT, for all four variants
    "paper": "the paper's recipe, one episode per agent",
    "two_iterations": "two iterations of the world model",
    "fine_tuned": "two iterations and fine-tuning",
    "first_iteration": "the first of the two iterations",
    "no_bar": "one iteration, without the indicator bar",
}
FINE_TUNING = {
    "evolution": {
        "generations": 15,
        "population": 32,
        "tracks": 8,
        "replay_share": 0.5,
        "sigma": 0.02,
        "sigma_decay": 0.97,
        "validate_every": 5,
        "averaged_share": 0.5,
    }
}


@dataclass(frozen=True)
class Experiment:
    """What is run for one line of the results."""

    about: str
    """What is special about it."""
    config: Config
    """Of the only iteration, of the second one, or of the fine-tuning."""
    first: Config | None = None
    """Of the first iteration of the world model, where there are two."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the CMA-ES runs. V and M, and a first iteration, are trained once for all of them."""
    world_model: str | None = None
    """The experiment whose dataset, V and M it shares; None for its own."""
    base: str | None = None
    """The experiment whose runs it fine-tunes, seed by seed."""
    retrained: bool = False
    """Whether each seed is a whole run, with its own dataset, V and M."""

    @property
    def variant(self) -> str:
        """What V sees and reconstructs."""
        return self.config.variant

    def config_of(self, seed: int) -> Config:
        """The configuration of one seed."""
        own = seed if self.retrained else self.config.seed
        return self.config.replace(seed=own, evolution={"seed": seed})


def recipe_experiments() -> dict[str, Experiment]:
    """The recipes that are run with all four variants, and the longer run of one of them."""
    found = {}
    second = {
        "data": {"agent_episodes": 110},
        "evolution": {"generations": 40, "sigma": 0.05, "replay_share": 0.5},
    }
    for variant in VARIANTS:
        own = {"variant": variant}
        paper = Config.preset("paper", **own, evolution={"step_size_rule": "TPA"})
        one = Config.preset("laptop", **own, data={"crop_bar": False})
        first = one.replace(evolution={"generations": 15})
        two = first.replace(**second)
        recipes = {
            "paper": {"config": paper},
            "two_iterations": {"config": two, "first": first},
            "fine_tuned": {
                "config": two.replace(**FINE_TUNING),
                "base": f"two_iterations_{variant}",
            },
            "first_iteration": {"config": first, "seeds": (0, 1, 2, 3, 4), "retrained": True},
            "no_bar": {
                "config": Config.preset("laptop", **own),
                "seeds": (0, 1),
                "retrained": True,
            },
        }
        for name, fields in recipes.items():
            found[f"{name}_{variant}"] = Experiment(RECIPES[name], **fields)
    return found


def changed_experiments(recipes: dict[str, Experiment]) -> dict[str, Experiment]:
    """Experiments that change one thing, all with the variant `input`."""
    two = recipes["two_iterations_input"]
    one = Experiment("one iteration", two.first.replace(evolution={"generations": 55}))
    found = {"one_iteration": one}
    for name, (about, changes, shared) in CHANGES.items():
        config = found[shared or "one_iteration"].config.replace(**changes)
        found[name] = Experiment(about, config, seeds=(0,), world_model=shared)
    for name, (about, changes, both) in TWO_ITERATIONS_CHANGES.items():
        first = two.first.replace(**changes) if both else two.first
        shared = "two_iterations_input" if name == "long_two_iterations" else None
        found[name] = Experiment(about, two.config.replace(**changes), first, (0,), shared)
    return found


# Name -> what it is, the change, and the experiment whose V and M it shares (None: its own).
CHANGES = {
    "z_only": ("C sees z alone", {"evolution": {"features": "z"}}, "one_iteration"),
    "h_only": ("C sees h alone", {"evolution": {"features": "h"}}, "one_iteration"),
    "untrained_mdn_rnn": ("M is not trained", {"mdn_rnn": {"steps": 0}}, "one_iteration"),
    "small_population": (
        "16 agents on 4 tracks each",
        {"evolution": {"population": 16, "tracks": 4}},
        "one_iteration",
    ),
    "another_seed": ("everything from another seed", {"seed": 1}, None),
    "last_mean": (
        "the last CMA mean, not an average",
        {"evolution": {"averaged_share": 0.0}},
        "another_seed",
    ),
    "all_weights": (
        "every weight of C searched",
        {"evolution": {"components": 0, "step_size_rule": "TPA"}},
        "another_seed",
    ),
    "adaptive_sigma": (
        "step size adapted by CMA-ES",
        {"evolution": {"sigma_decay": 0.0}},
        "another_seed",
    ),
    **{f"stride_{k}": (f"stride {k}", {"vae": {"stride": k}}, None) for k in (1, 2, 8)},
    **{f"latent_{n}": (f"{n} latents", {"vae": {"latent_size": n}}, None) for n in (16, 64)},
}
# The same for two iterations; the last entry says whether the first iteration changes as well.
TWO_ITERATIONS_CHANGES = {
    "long_two_iterations": (
        "two iterations, four times as long",
        {"evolution": {"generations": 160, "sigma_decay": 0.99}},
        False,
    ),
    "no_replay": ("two iterations, new tracks only", {"evolution": {"replay_share": 0.0}}, False),
    "early_recipe": (
        "two iterations, before the recipe was improved",
        {
            "data": {"crop_bar": True},
            "evolution": {
                "population": 16,
                "tracks": 4,
                "replay_share": 0.0,
                "components": 0,
                "sigma_decay": 0.0,
                "step_size_rule": "TPA",
            },
        },
        True,
    ),
}
RECIPE_EXPERIMENTS = recipe_experiments()
EXPERIMENTS = RECIPE_EXPERIMENTS | changed_experiments(RECIPE_EXPERIMENTS)


def find_experiment(name: str, seeds: Sequence[int] | None = None) -> Experiment:
    """The experiment of a name, reduced to `seeds` if they are given.

    Raises:
        ValueError: no such experiment, or it has no such seed.
    """
    if name not in EXPERIMENTS:
        known = ", ".join([*EXPERIMENTS, *BASELINE_DRIVERS])
        raise ValueError(f"unknown experiment {name!r}: choose one of {known}")
    found = EXPERIMENTS[name]
    if unknown := [seed for seed in seeds or () if seed not in found.seeds]:
        raise ValueError(
            f"experiment {name!r} has no seed {unknown[0]}: choose from {list(found.seeds)}"
        )
    return dataclasses.replace(found, seeds=tuple(dict.fromkeys(seeds))) if seeds else found
