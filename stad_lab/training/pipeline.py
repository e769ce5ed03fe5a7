"""From an empty folder to a trained agent: four stages in order, each resumable, and a record.

The folder of a run::

    dataset/                  the random driver's episodes, in a second iteration an agent's too
    vae.safetensors           V
    mdn_rnn.safetensors       M
    evolution.json            every generation of CMA-ES
    controller.safetensors    C: the averaged CMA mean with the best validation
    components.safetensors    along which CMA-ES varies C, with `evolution.components`
    start.safetensors         the first C, in a second iteration or a fine-tuning
    record.json               configuration, versions, machine, time and budget of each stage
"""

import functools
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

import torch

from stad_lab.config import Config
from stad_lab.inference import Inference
from stad_lab.io.files import load_json, locked, save_json
from stad_lab.io.weights import (
    CONTROLLER_FILE,
    MDN_RNN_FILE,
    VAE_FILE,
    load_training,
    load_world_model,
)
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE
from stad_lab.training import second_iteration
from stad_lab.training.dataset import (
    MANIFEST,
    Dataset,
    check_seen,
    collect,
    made_with,
    read_manifest,
)
from stad_lab.training.evolution import LOG, evolve, read_log
from stad_lab.training.mdn_rnn import CHECKPOINT as MDN_RNN_TRAINING
from stad_lab.training.mdn_rnn import check_mdn_rnn, mdn_rnn_depends_on, train_mdn_rnn
from stad_lab.training.record import (
    RECORD,
    budget,
    check_record,
    command_of,
    fine_tuning_command,
    open_record,
    provenance,
    read_finished,
    timed,
)
from stad_lab.training.subspace import COMPONENTS_FILE, START_FILE, find_components
from stad_lab.training.vae import CHECKPOINT as VAE_TRAINING
from stad_lab.training.vae import check_vae, train_vae, vae_depends_on

STAGES = ("dataset", "vae", "mdn_rnn", "controller")
WEIGHTS = (VAE_FILE, MDN_RNN_FILE, START_FILE, COMPONENTS_FILE, CONTROLLER_FILE)
RUN_FILES = (*WEIGHTS, LOG, RECORD, MANIFEST)

Stage = Callable[[Executor | None], bool]
"""Does what is missing; returns False if nothing was."""
StageWatch = Callable[[str, list[dict]], None]
"""Called with a stage's name and its history, or the generations of CMA-ES."""


def train(
    config: Config,
    folder: str | Path,
    dataset_folder: str | Path | None = None,
    until: str = "controller",
    executor: Executor | None = None,
    earlier: str | Path | None = None,
    watch: StageWatch | None = None,
) -> bool:
    """Run every stage up to `until` that is not finished in `folder`; False if all were.

    After an interruption the same call continues.

    Args:
        folder: of the run; made if missing.
        dataset_folder: where the dataset is, or goes; None for `folder/dataset`.
        until: the last stage, one of STAGES.
        executor: where episodes run; None for `config.processes` threads of this machine.
        earlier: in a second iteration, the folder of the run whose agent drives
            `data.agent_episodes` for the dataset, and whose C is carried over.
        watch: told what the stages "vae", "mdn_rnn" and "controller" have logged, as it grows.

    Raises:
        ValueError: a wrong argument, or a file in the folder that is damaged or of another run.
        OSError: another process works in the folder, or a file cannot be read or written.
        TaskError, FloatingPointError: as raised by the stages.
    """
    if until not in STAGES:
        raise ValueError(f"unknown stage {until!r}: choose one of {', '.join(STAGES)}")
    if (config.data.agent_episodes > 0) != (earlier is not None):
        raise ValueError(
            f"data.agent_episodes={config.data.agent_episodes} and earlier={earlier}: a second"
            " iteration needs both, the number of episodes and the run whose agent drives them"
        )
    folder = Path(folder)
    data = folder / "dataset" if dataset_folder is None else Path(dataset_folder)
    before = None
    if earlier is not None:
        earlier = Path(earlier)
        check_apart(earlier, folder)
        before = read_finished(earlier)
        second_iteration.check_earlier_agent(config, earlier)
    check_stages(config, folder, data)
    stages = make_stages(config, folder, data, earlier, watch)
    wanted = {name: stages[name] for name in STAGES[: STAGES.index(until) + 1]}
    return run_stages(wanted, config, folder, data, executor, before)


def make_stages(
    config: Config, folder: Path, data: Path, earlier: Path | None, watch: StageWatch | None = None
) -> dict[str, Stage]:
    """The four stages as functions of the executor that drives."""
    watched = {name: watch and functools.partial(watch, name) for name in STAGES[1:]}
    dataset = functools.cache(lambda: Dataset(data))  # read and checked once for all stages

    def collect_stage(executor: Executor | None) -> bool:
        if earlier:
            return second_iteration.collect_again(config, earlier, data, executor)
        return collect(config, data, executor)

    def controller_stage(executor: Executor | None) -> bool:
        did = earlier is not None and second_iteration.carry_over(config, earlier, dataset, folder)
        did |= find_components(config, dataset, folder)
        return did | evolve(config, folder, executor, watched["controller"])

    return {
        "dataset": collect_stage,
        "vae": lambda _: train_vae(config, dataset, folder, watched["vae"]),
        "mdn_rnn": lambda _: train_mdn_rnn(config, dataset, folder, watched["mdn_rnn"]),
        "controller": controller_stage,
    }


def check_apart(earlier: Path, folder: Path) -> None:
    """Raise ValueError if a run would be continued in its own folder."""
    if earlier.resolve() == folder.resolve():
        raise ValueError(f"{folder} is the run that is continued: choose another folder for --out")


def check_stages(config: Config, folder: Path, data: Path) -> None:
    """Raise ValueError, before any work, if a stage begun in the folder is of another run.

    Or if `Inference`, with which agents drive, refuses V or M of this configuration.
    """
    check_record(folder)
    with torch.random.fork_rng([]):
        Inference(VAE.of(config).float(), MDNRNN.of(config).float())
    if not config.data.agent_episodes:
        read_manifest(data, made_with(config))
    for weights, training, depends_on in (
        (VAE_FILE, VAE_TRAINING, vae_depends_on(config)),
        (MDN_RNN_FILE, MDN_RNN_TRAINING, mdn_rnn_depends_on(config)),
    ):
        if not (folder / weights).exists() and (folder / training).exists():
            load_training(folder / training, depends_on)
    if (folder / VAE_FILE).exists():
        seen = check_vae(config, folder)["dataset"]
        check_seen(folder / VAE_FILE, seen, data)
        # Without V, for example because a damaged one was deleted, M is checked when V is trained.
        if (folder / MDN_RNN_FILE).exists():
            check_mdn_rnn(config, folder)
            if (folder / LOG).exists():
                read_log(config, folder, load_world_model(folder))


def run_stages(
    stages: dict[str, Stage],
    config: Config,
    folder: Path,
    data: Path | None,
    executor: Executor | None,
    before: dict | None,
) -> bool:
    """Run some stages in order and keep the record of the run; False if nothing was to do.

    `data` is the dataset's folder, None in a fine-tuning; `before` is the earlier run's record.
    """
    worked = False
    with locked(folder):
        made = provenance(command_of(config) if data else fine_tuning_command(config))
        record = open_record(config, folder, before, made)
        for name, stage in stages.items():
            with timed(record, made, name, folder) as note:
                try:
                    did = stage(executor)
                except (ValueError, OSError):  # refused: what it noted so far stays
                    raise
                except BaseException:  # an interrupted stage has worked, too
                    note()
                    raise
                if did:
                    note()
            print(f"{name}: {'done' if did else 'already there, nothing to do'}", flush=True)
            worked |= did
        record["budget"] = budget(config, folder, data)
        path = folder / RECORD
        if worked or not path.exists() or load_json(path) != record:
            save_json(path, record)
    return worked
