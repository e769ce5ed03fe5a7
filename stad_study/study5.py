"""Study 5 of docs/protocol.md: is it the motion? C is evolved again on the worlds of study 1.

A world is the V and M of one seed and variant, as study 1 keeps them. A run evolves one C in it and
scores it; the three runs of an arm differ in their evolution seed. In the folder of the study::

    seed0/frame/world.safetensors   what the arms of a world need, from the seed's dataset
    seed0/frame/z_+_motion/1/       a run: components, the log of CMA-ES, and the score

"""

from pathlib import Path
from typing import NamedTuple

from stad_lab.config import Config
from stad_lab.io.files import locked
from stad_lab.training.subspace import COMPONENTS_FILE, save_components
from stad_study import tables
from stad_study.evolved import Evolved
from stad_study.networks import find_world_model, load_kept_world_model
from stad_study.senses import Sense
from stad_study.study import COLLECTING, STUDIES
from stad_study.world_facts import WORLD_FILE, load_sense, prepare_seed

REPEATS = (1, 2, 3)
FIRST_EVOLUTION_SEED = 100  # study 1 has 0 to 11
ARMS = {  # part -> variant and what C sees
    "5a": [(one, sees) for one in ("frame", "input", "input_output") for sees in ("z", "z, h")],
    "5b": [("input_output", "z - motion"), ("input_output", "z - placebo")],
    "5c": [("frame", f"z + {what}") for what in ("motion", "placebo", "action")]
    + [("input_output", "z + motion")],
}


class Run(NamedTuple):
    """One C; its name is also its folder."""

    seed: int
    variant: str
    sees: str
    repeat: int

    @property
    def name(self) -> str:
        """For example "seed0/frame/z_h/1" or "seed0/frame/z_+_motion/1"."""
        sees = self.sees.replace(", ", "_").replace(" ", "_")
        return f"seed{self.seed}/{self.variant}/{sees}/{self.repeat}"

    @property
    def config(self) -> Config:
        """Its configuration. Candidates and tracks depend on the seed and the repeat alone."""
        features = "z, h" if self.sees == "z, h" else "z"
        evolution = {"seed": FIRST_EVOLUTION_SEED + self.repeat, "features": features}
        own = {"variant": self.variant, "seed": self.seed, "processes": 1, "evolution": evolution}
        return STUDIES["study1"].config.replace(**own)


def parts_of_study5(_: Path = tables.DATA) -> dict[str, list[Run]]:
    """Part -> its runs, seed by seed."""
    return {
        part: [
            Run(seed, *arm, repeat)
            for seed in STUDIES["study1"].seeds
            for repeat in REPEATS
            for arm in arms
        ]
        for part, arms in ARMS.items()
    }


def prepare(run: Run, root: Path, networks: Path) -> Sense:
    """What C drives with; writes the facts of the seed's worlds, and the components of the run."""
    seed, folder = root / f"seed{run.seed}", root / run.name
    model = load_kept_world_model(find_world_model(networks, "study1", run.seed, run.variant))
    world = seed / run.variant / WORLD_FILE
    with locked(seed, COLLECTING):  # another process may be writing it
        if not world.exists():
            prepare_seed(run.seed, seed, networks)
    sense, components = load_sense(world, model, run.sees)
    if not (folder / COMPONENTS_FILE).exists():
        depends_on = {"variant": run.variant, "features": run.config.evolution.features}
        metadata = {**depends_on, "count": run.config.evolution.components, **sense.checksums}
        save_components(folder / COMPONENTS_FILE, *components, metadata)
    return sense


STUDY5 = Evolved("study5", parts_of_study5, prepare)
