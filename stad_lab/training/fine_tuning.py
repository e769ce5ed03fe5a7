"""Fine-tuning: CMA-ES continues from a finished C, with more tracks for each candidate.

CMA-ES ranks its candidates. Where each drives one track in a generation, the fastest lead, and a
failure on one track in twenty rarely counts. In the fine-tuning stage each drives eight tracks, and
one failure weighs more in their mean than any gain in speed. That takes eight times the episodes,
so it comes last, when small steps from a good C suffice. Nothing is collected or trained.
"""

import dataclasses
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from stad_lab.agent import load_agent
from stad_lab.config import Config, check_same
from stad_lab.io import weights
from stad_lab.io.files import copy_file
from stad_lab.io.weights import CONTROLLER_FILE, MDN_RNN_FILE, VAE_FILE
from stad_lab.training.evolution import LOG, evolve
from stad_lab.training.pipeline import check_apart, run_stages
from stad_lab.training.record import read_finished
from stad_lab.training.subspace import COMPONENTS_FILE, START_FILE, load_start, save_start

FINE_TUNING = {  # what it changes in the configuration of the run that it continues from
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
# Beside these, what may differ from the earlier run.
OPEN = (*FINE_TUNING["evolution"], "seed", "validation_tracks", "cars")
TAKEN = (VAE_FILE, MDN_RNN_FILE, COMPONENTS_FILE)  # from the earlier run


def fine_tuning_config(earlier: str | Path, **changes) -> Config:
    """The configuration of a fine-tuning of the run in `earlier`, with further changes.

    ValueError for a wrong field or value, or an unfinished run; FileNotFoundError without a run.
    """
    record = read_finished(Path(earlier))
    return Config.from_dict(record["config"]).replace(**FINE_TUNING).replace(**changes)


def fine_tune(
    config: Config, earlier: str | Path, folder: str | Path, executor: Executor | None = None
) -> bool:
    """Continue CMA-ES from the C of the run in `earlier`; False if everything was finished already.

    `folder` becomes a run of its own, with copies of V and M and with the earlier run's record.
    `config` is such as `fine_tuning_config` makes; `executor` is as for `evolve`.

    Raises:
        ValueError: a setting outside OPEN is not the earlier run's, that run is damaged or not
            finished, or `folder` holds another run.
        FileNotFoundError: the earlier run lacks a file.
        OSError, TaskError: as `evolve`.
    """
    earlier, folder = Path(earlier), Path(folder)
    check_apart(earlier, folder)
    before = read_finished(earlier)
    fixed = {name: value for name, value in config.as_dict().items() if name != "processes"}
    settings = dataclasses.asdict(config.evolution)
    fixed["evolution"] = {name: value for name, value in settings.items() if name not in OPEN}
    check_same(earlier, before["config"], fixed)
    load_agent(earlier)  # that V, M and C are whole, before any work

    def stage(executor: Executor | None) -> bool:
        return begin(config, earlier, folder) | evolve(config, folder, executor)

    return run_stages({"controller": stage}, config, folder, None, executor, before)


def begin(config: Config, earlier: Path, folder: Path) -> bool:
    """Copy the earlier run's V, M and components, and its C as the first one; False if done.

    ValueError, before anything is written, if the folder holds another run.
    """
    if (folder / LOG).exists() and not (folder / START_FILE).exists():
        raise ValueError(f"{folder} holds a run that continues no other: choose another folder")
    taken = [name for name in TAKEN if (earlier / name).exists()]
    there = [name for name in TAKEN if (folder / name).exists()]
    for name in there:
        if name not in taken or (earlier / name).read_bytes() != (folder / name).read_bytes():
            raise ValueError(f"{folder / name} is not that of {earlier}: choose another folder")
    for name in set(taken) - set(there):
        copy_file(earlier / name, folder)
    path, world_model = folder / START_FILE, weights.load_world_model(folder)
    parameters, _ = weights.load_controller(earlier / CONTROLLER_FILE)
    if path.exists():
        if not np.array_equal(load_start(path, world_model), parameters):
            raise ValueError(f"{folder} continues from another C than that of {earlier}")
        return False
    save_start(path, parameters, config.variant, world_model)
    return True
