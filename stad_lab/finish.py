"""A finish: one more search, from the C that a run has found and with its V and M, against rare failures.

CMA-ES ranks. Where every agent drives one track in a generation, the fastest lead on nearly all tracks, and that they
lose hundreds of points on one in twenty counts in as few generations. In a finish every agent drives eight tracks, and
in their mean a single failure weighs more than all that haste can gain. That costs eight times the episodes for an
agent, so it is kept for the end, when small steps from a good C are enough. Nothing is collected or trained.
"""

import shlex
import shutil
from concurrent.futures import Executor
from pathlib import Path

import torch

from stad_lab.agent import load_controller, read_world_model
from stad_lab.autoencoder import check_variant
from stad_lab.checkpoints import load_json, locked, save_tensors
from stad_lab.evolution import CONTROLLER, evolve
from stad_lab.mdn_rnn import check_partner
from stad_lab.pipeline import EARLIER, open_record, run_stages
from stad_lab.search_space import COMPONENTS, START, load_start
from stad_lab.settings import Settings, check_same_run, known_fields

FINISH = {  # what it changes in the settings of the run that it goes on from
    "generations": 15,
    "population": 32,
    "tracks": 8,
    "revisited_share": 0.5,
    "sigma": 0.02,
    "sigma_decay": 0.97,
    "validate_every": 5,
    "averaged_share": 0.5,
}
OPEN = (*FINISH, "evolution_seed", "validation_tracks", "cars", "processes")  # what may be changed; no V depends on it


def finish_settings(earlier: str | Path, **changes) -> Settings:
    """The settings of a finish of the run in `earlier`: that run's, with those of FINISH and other changes.

    Raises:
        ValueError, FileNotFoundError: an unknown field, a value out of range, or no record of a run.
    """
    record = load_json(Path(earlier) / "record.json", EARLIER)
    return Settings.from_dict(record["settings"] | FINISH | known_fields(changes))


def finish(
    variant: str, settings: Settings, earlier: str | Path, folder: str | Path, executor: Executor | None = None
) -> bool:
    """Search on from the C of the run in `earlier`; run it again after an interrupt to go on.

    `folder` becomes a run of its own, with copies of V and M, and with the earlier run's record in its own.

    Args:
        settings: as `finish_settings` makes them.
        executor: who drives; None for `settings.processes` processes of this machine.

    Returns:
        False if everything was finished already and nothing was done.

    Raises:
        ValueError: settings on which V or M depend are not the earlier run's, or `folder` holds another run.
        FileNotFoundError: the earlier run has no record, or no C yet.
        OSError, TaskError: as `evolve`.
    """
    check_variant(variant)
    earlier, folder = Path(earlier), Path(folder)
    record = load_json(earlier / "record.json", EARLIER)
    fixed = {name: value for name, value in settings.as_dict().items() if name not in OPEN}
    check_same_run(earlier, {"variant": record["variant"], **record["settings"]}, {"variant": variant, **fixed})
    stages = {
        "controller": lambda pool: begin_finish(variant, earlier, folder) | evolve(variant, settings, folder, pool)
    }
    load_controller(earlier / CONTROLLER, variant)
    with locked(folder):
        record = open_record(folder, variant, settings, command_of(variant, settings, earlier), earlier)
        return run_stages(stages, ["controller"], record, folder, None, executor)


def begin_finish(variant: str, earlier: Path, folder: Path) -> bool:
    """Copy V, M and the components of the earlier run, and write its C as `start.safetensors`.

    Returns:
        False if they were there already.

    Raises:
        ValueError, FileNotFoundError: a file of one of the runs is damaged, missing, or belongs to another run.
    """
    for name in ("autoencoder.safetensors", "mdn_rnn.safetensors", COMPONENTS):
        if (earlier / name).exists() and not (folder / name).exists():
            shutil.copy(earlier / name, folder)
    path, world_model = folder / START, read_world_model(folder, variant)
    if path.exists():
        load_start(path, world_model)
        return False
    parameters, facts = load_controller(earlier / CONTROLLER, variant)
    check_partner(earlier / CONTROLLER, facts, **world_model.identities)
    start = {"parameters": torch.from_numpy(parameters)}
    save_tensors(path, start, part="start", variant=variant, **world_model.identities)
    return True


def command_of(variant: str, settings: Settings, earlier: Path) -> str:
    """The command line that makes a finish of these settings again."""
    usual = finish_settings(earlier).as_dict()
    changed = [f"{name}={value}" for name, value in settings.as_dict().items() if value != usual[name]]
    changes = [f"--set {shlex.quote(change)}" for change in changed]
    return " ".join([f"python -m stad_lab finish --variant {variant} --path ... --out ...", *changes])
