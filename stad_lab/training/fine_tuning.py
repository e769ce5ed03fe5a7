"""A finish: one more search, from the C that a run has found and with its V and M, against rare failures.

CMA-ES ranks. Where every agent drives one track in a generation, the fastest lead on nearly all tracks, and that they
lose hundreds of points on one in twenty counts in as few generations. In a finish every agent drives eight tracks, and
in their mean a single failure weighs more than all that haste can gain. That costs eight times the episodes for an
agent, so it is kept for the end, when small steps from a good C are enough. Nothing is collected or trained.

Tracks and mutations are drawn with the seeds of the earlier run, by the number of the generation: where that run drove
a new track in a generation of this number, it is the first of the new ones here.
"""

from concurrent.futures import Executor
from pathlib import Path

from stad_lab.agent import CONTROLLER, load_agent, load_controller, read_world_model
from stad_lab.config import Settings
from stad_lab.io.files import copy_file, load_json, locked
from stad_lab.io.workers import refuse_in_starting_worker
from stad_lab.models.mdn_rnn import check_partner
from stad_lab.models.vae import check_variant
from stad_lab.training.evolution import evolve
from stad_lab.training.pipeline import (
    GIVE_A_RUN,
    open_record,
    read_finished,
    run_stages,
    set_options,
)
from stad_lab.training.subspace import COMPONENTS, START, load_directions, load_start, save_start

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
OPEN = (*FINISH, "evolution_seed", "validation_tracks", "cars", "processes")  # what may be changed


def finish_settings(earlier: str | Path, /, **changes) -> Settings:
    """The settings of a finish of the run in `earlier`: that run's, with those of FINISH and other changes.

    Raises:
        ValueError, FileNotFoundError: an unknown field, a value out of range, or no record of a run.
    """
    record = load_json(Path(earlier) / "record.json", GIVE_A_RUN)
    if "settings" not in record:
        raise ValueError(
            f"{earlier} is of {record['variant']}, which has no C to go on from: {GIVE_A_RUN}"
        )
    return Settings.from_dict(record["settings"] | FINISH | changes)


def finish(
    variant: str,
    settings: Settings,
    earlier: str | Path,
    folder: str | Path,
    executor: Executor | None = None,
) -> bool:
    """Search on from the C of the run in `earlier`; run it again after an interrupt to go on.

    `folder` becomes a run of its own, with copies of V and M, and with the earlier run's record in its own.

    Args:
        settings: as `finish_settings` makes them.
        executor: who drives; None for `settings.processes` processes of this machine.

    Returns:
        False if everything was finished already and nothing was done.

    Raises:
        ValueError: a setting outside OPEN is not the earlier run's, that run is damaged or not at its end, or `folder`
            holds another run.
        FileNotFoundError: the earlier run lacks a file.
        OSError, TaskError: as `evolve`.
    """
    refuse_in_starting_worker()
    check_variant(variant)
    earlier, folder = Path(earlier), Path(folder)
    before = check_earlier(variant, settings, earlier)
    stages = {
        "controller": lambda pool: (
            begin_finish(variant, earlier, folder) | evolve(variant, settings, folder, pool)
        )
    }
    command = f"python -m stad_lab finish --variant {variant} --path ... --out ..."
    command += set_options(settings, finish_settings(earlier))
    with locked(folder):
        record = open_record(folder, variant, settings, command, before)
        return run_stages(stages, ["controller"], record, folder, None, executor)


def check_earlier(variant: str, settings: Settings, earlier: Path) -> dict:
    """The record of the earlier run, if a finish with these settings can go on from it. Raises as `finish`."""
    record = read_finished(earlier)
    was = {"variant": record["variant"], **Settings.from_dict(record["settings"]).as_dict()}
    for name, value in {"variant": variant, **settings.as_dict()}.items():
        if name not in OPEN and was[name] != value:
            raise ValueError(
                f"{name}={value!r}, but the run in {earlier} has {was[name]!r}: leave it so, a finish may change"
                f" {', '.join(OPEN)} alone"
            )
    load_agent(variant, earlier)
    if settings.components:
        load_directions(earlier / COMPONENTS, read_world_model(earlier, variant))
    return record


def begin_finish(variant: str, earlier: Path, folder: Path) -> bool:
    """Copy V, M and the components of the earlier run, and write its C as `start.safetensors`, the last of them.

    Returns:
        False if that was there already.

    Raises:
        ValueError, OSError: a file of one of the runs is damaged, or belongs to another run, or cannot be written.
    """
    for name in ("autoencoder.safetensors", "mdn_rnn.safetensors", COMPONENTS):
        if (earlier / name).exists() and not (folder / name).exists():
            copy_file(earlier / name, folder)
    path, world_model = folder / START, read_world_model(folder, variant)
    if path.exists():
        load_start(path, world_model)
        return False
    parameters, facts = load_controller(earlier / CONTROLLER, variant)
    check_partner(earlier / CONTROLLER, facts, **world_model.identities)
    save_start(path, parameters, variant, world_model)
    return True
