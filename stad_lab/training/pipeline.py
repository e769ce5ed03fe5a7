"""From an empty folder to a trained agent: the four stages in order, each resumable, and the record of the run.

The folder of a run::

    rollouts/                     the random driver's episodes, in a second round the earlier agent's too
    autoencoder.safetensors       V
    mdn_rnn.safetensors           M
    evolution.json                every generation of CMA-ES
    controller.safetensors        C: the average of the last CMA means, when it drove the validation tracks best
    components.safetensors        where C is searched, with `Settings.components`
    start.safetensors             only in a second round or a finish: the earlier run's C, for the V and M here
    record.json                   variant, settings, versions, commit, and the time (in seconds) and the budget of every
                                  stage, and the most memory that a process has held by its end (in MB, for each start);
                                  a start that was killed, or that a full disk or a refused file ended, leaves no
                                  trace in it
"""

import importlib.metadata
import itertools
import os
import platform
import shlex
import subprocess
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from pathlib import Path

import torch

from stad_lab.agent import CONTROLLER, PRETRAINED
from stad_lab.config import Settings, check_same_run
from stad_lab.io.files import copy_file, load_json, load_tensors, locked, save_json, save_tensors
from stad_lab.io.workers import peak_memory, refuse_in_starting_worker, worker_processes
from stad_lab.models.mdn_rnn import train_mdn_rnn
from stad_lab.models.vae import check_variant, load_autoencoder, train_autoencoder
from stad_lab.training.dataset import COLLECT_SETTINGS, MANIFEST, collect_rollouts
from stad_lab.training.evolution import LOG, evolve
from stad_lab.training.second_iteration import (
    carry_over,
    check_earlier_agent,
    collect_again,
    order_of_episodes,
)
from stad_lab.training.subspace import COMPONENTS, START, find_components
from stad_lab.training.trainer import training_device

STAGES = ("rollouts", "autoencoder", "mdn_rnn", "controller")
PACKAGES = (
    "torch",
    "numpy",
    "gymnasium",
    "box2d",
    "pygame-ce",
    "cma",
    "opencv-python-headless",
    "safetensors",
)
MACHINE = ("python", "platform", "processor", "cores", "trained_on")
WEIGHTS = ("autoencoder.safetensors", "mdn_rnn.safetensors", START, COMPONENTS, CONTROLLER)
GIVE_A_RUN = "give the folder of a run, as `python -m stad_lab train --out` makes it"


def train(
    variant: str,
    settings: Settings,
    folder: str | Path,
    rollouts_folder: str | Path | None = None,
    until: str = "controller",
    executor: Executor | None = None,
    earlier: str | Path | None = None,
) -> bool:
    """Run every stage up to `until` that is not finished in `folder`; run it again after an interrupt to go on.

    Args:
        variant: "frame", "input", "output" or "input_output".
        folder: of the run; made if missing.
        rollouts_folder: where the rollouts are, or go; None for `folder/rollouts`. Runs may share one.
        until: the last stage to run.
        executor: who drives; None for `settings.processes` processes of this machine.
        earlier: folder of the run whose agent drives `settings.agent_episodes` for the rollouts, and whose C is carried
            over (see `second_round`); None in a first round.

    Returns:
        False if everything was finished already and nothing was done.

    Raises:
        ValueError: an unknown variant or stage, a folder with a run of another variant or other settings, or with a
            file that is damaged or belongs to another run, or an earlier run whose V has seen the bar otherwise, whose
            V, M and C do not belong together, that is not at its end, or that is not as it was when this second round
            began.
        OSError: another process works in the folder, or a file cannot be read or written.
        TaskError, FloatingPointError: as raised by the stages.
    """
    refuse_in_starting_worker()
    check_variant(variant)
    if until not in STAGES:
        raise ValueError(f"unknown stage {until!r}: choose one of {', '.join(STAGES)}")
    if (settings.agent_episodes > 0) != (earlier is not None):
        raise ValueError(
            f"agent_episodes={settings.agent_episodes} and earlier={earlier}: a second round needs both, the number of"
            " episodes and the folder of the run whose agent drives them; a first round has neither"
        )
    before = None
    if earlier is not None:
        before = read_finished(Path(earlier))
        check_earlier_agent(variant, settings, Path(earlier))
    folder = Path(folder)
    rollouts_folder = folder / "rollouts" if rollouts_folder is None else Path(rollouts_folder)
    stages = {
        "rollouts": lambda pool: collect_rollouts(settings, rollouts_folder, pool),
        "autoencoder": lambda _: train_autoencoder(variant, settings, rollouts_folder, folder),
        "mdn_rnn": lambda _: train_mdn_rnn(variant, settings, rollouts_folder, folder),
        "controller": lambda pool: (
            find_components(variant, settings, rollouts_folder, folder)
            | evolve(variant, settings, folder, pool)
        ),
    }
    if earlier is not None:
        again = (variant, settings, Path(earlier), rollouts_folder)
        stages["rollouts"] = lambda pool: collect_again(*again, pool)
        search = stages["controller"]
        stages["controller"] = lambda pool: carry_over(*again, folder) | search(pool)
    with locked(folder):
        record = open_record(folder, variant, settings, command_of(variant, settings), before)
        return run_stages(
            stages, STAGES[: STAGES.index(until) + 1], record, folder, rollouts_folder, executor
        )


def run_stages(
    stages: dict[str, Callable[[Executor], bool]],
    wanted: Sequence[str],
    record: dict,
    folder: Path,
    rollouts_folder: Path | None,
    executor: Executor | None,
) -> bool:
    """Run the wanted stages in order and keep the record of them; False if there was nothing to do."""
    worked = False
    for stage in wanted:
        begin, did, pool = time.perf_counter(), True, None  # an interrupted stage has worked too
        try:
            with worker_processes(record["settings"]["processes"], executor) as pool:
                did = stages[stage](pool)
        except (ValueError, OSError):  # refused: what is in the folder stays as it is
            did = False
            raise
        finally:
            if did:
                record["seconds"][stage] = (
                    record["seconds"].get(stage, 0.0) + time.perf_counter() - begin
                )
                record.setdefault("peak_memory", {}).setdefault(stage, []).append(peak_memory(pool))
                save_json(folder / "record.json", record)
        print(f"{stage}: {'done' if did else 'already there, nothing to do'}")
        worked |= did
    spent = budget(Settings.from_dict(record["settings"]), folder, rollouts_folder)
    if worked or spent != record.get(
        "budget"
    ):  # a kill may have come between the last generation and this line
        record["budget"] = spent
        save_json(folder / "record.json", record)
    return worked


def read_finished(earlier: Path) -> dict:
    """The record of a run, whose search for C must be at its end.

    Raises:
        ValueError: it is not, or a file is damaged.
        FileNotFoundError: there is no run, or no log of a search.
    """
    record = load_json(earlier / "record.json", GIVE_A_RUN)
    log = load_json(earlier / LOG, GIVE_A_RUN)
    done, asked = (
        len(log["generations"]),
        log["settings"]["generations"],
    )  # of a longer run the log knows first
    if (
        done != asked
        or record.get("budget", {}).get("agents") != asked * record["settings"]["population"]
    ):
        raise ValueError(
            f"the search in {earlier} is not at its end, with {done} of {asked} generations: run its own command to the"
            " end first"
        )
    return record


def open_record(
    folder: Path, variant: str, settings: Settings, command: str, before: dict | None = None
) -> dict:
    """The record of the run in `folder`, or a new one.

    Args:
        before: the record of the run that a second round, or a finish, goes on from; this one's holds it.

    What it was "made_with" stays that of the first start; a later one by other means adds to "continued_with".

    Raises:
        ValueError: the folder holds a run of another variant or of other settings, or one that went on from another
            run, or from the same when it was less far.
    """
    path = folder / "record.json"
    if not path.exists() or is_empty_run(folder):
        record = {
            "variant": variant,
            "settings": settings.as_dict(),
            "made_with": provenance(command),
            "seconds": {},
        }
        if before is not None:
            record["earlier"] = before
        save_json(path, record)
        return record
    record = load_json(path)
    if "settings" not in record:
        raise ValueError(
            f"{folder} holds the record of {record['variant']}, which is no run: choose another folder"
        )
    check_same_run(
        path,
        {"variant": record["variant"], **record["settings"]},
        {"variant": variant, **settings.as_dict()},
    )
    if what_counts(record.get("earlier")) != what_counts(before):
        raise ValueError(
            f"{folder} holds a run that does not go on from the one given as it is now: choose another folder, or give"
            " the run that it goes on from"
        )
    made = provenance(command)
    if made != starts(record)[-1]:
        record["continued_with"] = [*starts(record)[1:], made]
    return record | {"settings": settings.as_dict()}


def is_empty_run(folder: Path) -> bool:
    """Whether a folder holds nothing but the record of a run that was refused before it made anything."""
    files = (file for file in folder.rglob("*") if file.is_file() and not file.name.startswith("."))
    found = [file.name for file in itertools.islice(files, 2)]
    return found == ["record.json"] and load_json(folder / "record.json").get("seconds") == {}


def what_counts(record: dict | None) -> dict | None:
    """What a later run owes to the run of a record: not how long its stages took, and not on which machine."""
    if record is None:
        return None
    settings = Settings.from_dict(record["settings"]).as_dict()
    return {
        "variant": record["variant"],
        "settings": {
            name: value for name, value in settings.items() if name not in ("name", "processes")
        },
        "budget": record.get("budget"),
        "earlier": what_counts(record.get("earlier")),
    }


def starts(record: dict) -> list[dict]:
    """What a run was made with, and all that it was continued with, the last start at the end."""
    return [record["made_with"], *record.get("continued_with", [])]


def command_of(variant: str, settings: Settings) -> str:
    """The command line that makes a run of these settings again."""
    command = f"python -m stad_lab train --variant {variant} --settings {settings.name} --out ..."
    changes = set_options(settings, Settings.preset(settings.name))
    return command + changes + (" --earlier ..." if settings.agent_episodes else "")


def set_options(settings: Settings, usual: Settings) -> str:
    """What a command line says to have these settings instead of the usual ones: " --set NAME=VALUE" of each change."""
    before = usual.as_dict()
    changed = [
        f"{name}={value}" for name, value in settings.as_dict().items() if value != before[name]
    ]
    return "".join(f" --set {shlex.quote(change)}" for change in changed)


def provenance(command: str) -> dict:
    """What a run was made with: versions, machine, command, and the commit if the code lies in a git checkout."""
    changes = git("status", "--porcelain", "--untracked-files=no", "--", ".")
    return {
        "python": platform.python_version(),
        **{package: importlib.metadata.version(package) for package in PACKAGES},
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),  # V's and M's last bits depend on them
        "trained_on": str(training_device()),
        "commit": git("rev-parse", "HEAD"),
        "uncommitted_changes": changes if changes is None else bool(changes),
        "command": command,
    }


def processor() -> str:
    """The processor's name, as far as the system tells it, and the instructions that PyTorch uses of it.

    On another one the last bits of a sum may differ, and with them a whole drive.
    """
    listed = Path("/proc/cpuinfo")
    name = (
        listed.read_text().partition("model name")[2].partition("\n")[0] if listed.exists() else ""
    )
    return f"{name.strip(chr(9) + ' :') or platform.processor()}, {torch.backends.cpu.get_cpu_capability()}"


def git(*arguments: str) -> str | None:
    """What git says about this checkout; None without git, or if this file is not in a checkout.

    An environment may lie in the checkout of something else, which does not track what is installed in it.
    """
    here = Path(__file__)
    try:
        for command in (["ls-files", "--error-unmatch", here.name], arguments):
            found = subprocess.run(
                ["git", "-C", str(here.parent), *command],
                capture_output=True,
                text=True,
                check=True,
            )
        return found.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def budget(settings: Settings, folder: Path, rollouts_folder: Path | None) -> dict:
    """Every logged episode and frame that was driven for this run, by what it was driven for.

    What an earlier run has cost is in that run's record, which lies in this one's: `total_budget` adds it. A finish
    has no rollouts of its own.
    """
    spent = {"random": {"episodes": 0, "frames": 0}}
    numbers = order_of_episodes(settings) if settings.agent_episodes else range(settings.episodes)
    for block in load_json(rollouts_folder / MANIFEST)["blocks"] if rollouts_folder else ():
        driver = "random" if numbers[block["index"]] < settings.episodes else "agent_driver"
        one = spent.setdefault(driver, {"episodes": 0, "frames": 0})
        one["episodes"] += 1
        one["frames"] += block["frames"]
    if (folder / LOG).exists():
        log = load_json(folder / LOG)["generations"]
        validations = [entry["validation"] for entry in log if "validation" in entry]
        spent["agents"] = sum(len(entry["returns"]) for entry in log)
        spent["evolution"] = {
            "episodes": sum(len(returns) for entry in log for returns in entry["returns"]),
            "frames": sum(entry["frames"] for entry in log),
        }
        spent["validation"] = {
            "episodes": sum(len(validation["returns"]) for validation in validations),
            "frames": sum(validation["frames"] for validation in validations),
        }
    return spent


def total_budget(record: dict) -> dict:
    """Agents, episodes and frames that a run has cost, with those of the earlier run that it was built on.

    The random driver's episodes of a second round are those of the first, made again instead of kept: they count once.
    """
    parts = [part for part in record["budget"].values() if isinstance(part, dict)]
    total = {unit: sum(part[unit] for part in parts) for unit in ("episodes", "frames")}
    total["agents"] = record["budget"].get("agents", 0)
    if "earlier" in record:
        before = total_budget(record["earlier"])
        again = all(
            record["settings"][field] == record["earlier"]["settings"][field]
            for field in COLLECT_SETTINGS
        )
        made_again = record["budget"]["random"] if again else {}
        total = {
            unit: count + before[unit] - made_again.get(unit, 0) for unit, count in total.items()
        }
    return total


def ship(variant: str, folder: str | Path, target: Path = PRETRAINED) -> Path:
    """Copy what a run has trained into `stad_lab/pretrained/`: records as they are, V and M in half precision.

    Half precision keeps a clone of the repository small. Evaluate the shipped agent after this, not the run. A second
    round, or a finish, goes into a folder `second_round` of its own; returns the new folder. All other files
    there with an ending, of an agent that was shipped before, are removed, its evaluation too.

    Raises:
        FileNotFoundError: the run has no V.
        ValueError: the run is damaged, of another variant, or the shipped agent itself.
    """
    folder = Path(folder)
    load_autoencoder(folder / "autoencoder.safetensors", variant)
    target = target / "second_round" / variant if (folder / START).exists() else target / variant
    if target.resolve() == folder.resolve():
        raise ValueError(f"{folder} is where agents are shipped to: give the folder of a run")
    shipped = [name for name in (*WEIGHTS, "record.json", LOG) if (folder / name).exists()]
    read = {
        name: load_tensors(folder / name) for name in shipped if name in WEIGHTS
    }  # all, before any is written
    for name, (tensors, facts) in read.items():
        small = {
            key: value.half() if value.dtype == torch.float32 else value
            for key, value in tensors.items()
        }
        save_tensors(target / name, small, **facts)
    for name in shipped:
        if name not in read:
            copy_file(folder / name, target)
    for file in target.glob("*.*"):
        if file.is_file() and file.name not in shipped:
            file.unlink()
    return target
