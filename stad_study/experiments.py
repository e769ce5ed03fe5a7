"""The experiments of the replication: a configuration (with its variant) and some seeds each.

Those that we report used pycma 4.5, which adapts sigma by two points (TPA) from 300
dimensions on, and by cumulative step-size adaptation (CSA) below; the configurations state which.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from stad_lab.config import VARIANTS, Config
from stad_lab.training.fine_tuning import FINE_TUNING

BASELINE_DRIVERS = {  # they do not see the road, and have no seeds
    "random_driver": "smooth random steering and gas, as in the dataset",
    "constant_driver": "straight on with little gas, as the first controller of CMA-ES",
}
RECIPES = {  # each is run with all four variants, as the experiments RECIPE_VARIANT
    "paper": "the paper's budget, one episode for each candidate",
    "two_iterations": "two iterations of the world model",
    "fine_tuned": "two iterations and fine-tuning",
    "first_iteration": "the first of the two iterations",
    "no_bar": "one iteration, without the indicator bar",
}


SECOND_ITERATION = {
    "data": {"agent_episodes": 110},
    "evolution": {"generations": 40, "sigma": 0.05, "replay_share": 0.5},
}
EARLY_RECIPE = {
    "data": {"crop_bar": True},
    "evolution": {
        "population": 16, "tracks": 4, "replay_share": 0.0,
        "components": 0, "sigma_decay": 0.0, "step_size_rule": "TPA",
    },
}  # fmt: skip
EARLY_PAPER = {"evolution": {"step_size_rule": "TPA", "tracks": 1}}
# Single changes of "one_iteration": the experiment whose dataset, V and M are shared (None: own
# ones) -> experiment -> (what it is, the change). The variant is `input`.
CHANGES: dict[str | None, dict[str, tuple[str, dict[str, Any]]]] = {
    None: {
        "another_seed": ("everything from another seed", {"seed": 1}),
        **{f"stride_{k}": (f"stride {k}", {"vae": {"stride": k}}) for k in (1, 2, 8)},
        **{f"latent_{n}": (f"{n} latents", {"vae": {"latent_size": n}}) for n in (16, 64)},
    },
    "one_iteration": {
        "z_only": ("C sees z alone", {"evolution": {"features": "z"}}),
        "h_only": ("C sees h alone", {"evolution": {"features": "h"}}),
        "untrained_mdn_rnn": ("M is not trained", {"mdn_rnn": {"steps": 0}}),
        "small_population": (
            "16 candidates on 4 tracks each", {"evolution": {"population": 16, "tracks": 4}}
        ),
    },
    "another_seed": {
        "last_mean": (
            "the last CMA mean, not an average", {"evolution": {"averaged_share": 0.0}}
        ),
        "all_weights": (
            "all weights optimised", {"evolution": {"components": 0, "step_size_rule": "TPA"}}
        ),
        "adaptive_sigma": ("step size adapted by CMA-ES", {"evolution": {"sigma_decay": 0.0}}),
    },
}  # fmt: skip


@dataclass(frozen=True)
class Experiment:
    """What is run for one line of the results."""

    about: str
    config: Config  # of the only iteration of V and M, of the second, or of the fine-tuning
    first: Config | None = None  # of the first iteration, where there are two
    seeds: tuple[int, ...] = (0, 1, 2)  # of CMA-ES; V and M are trained once for all of them
    world_model: str | None = None  # experiment whose dataset, V and M it shares; None: its own
    base: str | None = None  # experiment whose runs it fine-tunes, seed by seed
    retrained: bool = False  # each seed is a whole run, with its own dataset, V and M

    def config_of(self, seed: int) -> Config:
        """The configuration of one seed."""
        own = seed if self.retrained else self.config.seed
        return self.config.replace(seed=own, evolution={"seed": seed})


def make_experiments() -> dict[str, Experiment]:
    """All experiments by name."""
    found: dict[str, Experiment] = {}
    for name in VARIANTS:
        paper = Config.preset("paper", variant=name, **EARLY_PAPER)
        no_bar = Config.preset("laptop", variant=name)
        first = no_bar.replace(data={"crop_bar": False}, evolution={"generations": 15})
        two = first.replace(**SECOND_ITERATION)
        tuned, its_base = two.replace(**FINE_TUNING), f"two_iterations_{name}"
        recipes: dict[str, dict[str, Any]] = {
            "paper": {"config": paper},
            "two_iterations": {"config": two, "first": first},
            "fine_tuned": {"config": tuned, "base": its_base},
            "first_iteration": {"config": first, "seeds": (0, 1, 2, 3, 4), "retrained": True},
            "no_bar": {"config": no_bar, "seeds": (0, 1), "retrained": True},
        }
        for recipe, fields in recipes.items():
            found[f"{recipe}_{name}"] = Experiment(RECIPES[recipe], **fields)
    base = found["two_iterations_input"]
    assert base.first is not None
    one_iteration = base.first.replace(evolution={"generations": 55})
    found["one_iteration"] = Experiment("one iteration", one_iteration)
    for world_model, changed in CHANGES.items():
        for name, (about, changes) in changed.items():
            config = found[world_model or "one_iteration"].config.replace(**changes)
            found[name] = Experiment(about, config, None, (0,), world_model)
    only_new, about = base.config.replace(evolution={"replay_share": 0.0}), "two iterations, "
    early, early_first = (one.replace(**EARLY_RECIPE) for one in (base.config, base.first))
    improved = "before the recipe was improved"
    return found | {
        "no_replay": Experiment(about + "new tracks only", only_new, base.first, (0,)),
        "early_recipe": Experiment(about + improved, early, early_first, (0,)),
    }


EXPERIMENTS = make_experiments()


def find_experiment(name: str, seeds: Sequence[int] | None = None) -> Experiment:
    """The experiment of a name, with `seeds` alone if given; ValueError if there is none such."""
    if name not in EXPERIMENTS:
        raise ValueError(f"unknown experiment {name!r}: choose one of {', '.join(EXPERIMENTS)}")
    found = EXPERIMENTS[name]
    if unknown := set(seeds or ()) - set(found.seeds):
        raise ValueError(f"experiment {name!r} has no seed {min(unknown)}: it has {found.seeds}")
    return dataclasses.replace(found, seeds=tuple(dict.fromkeys(seeds))) if seeds else found
