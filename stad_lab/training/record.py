"""The record of a run: configuration, versions, machine, time and budget of each stage."""

import contextlib
import importlib.metadata
import os
import platform
import shlex
import subprocess
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from threadpoolctl import threadpool_info

from stad_lab.config import PRESETS, Config, check_same, fields_of
from stad_lab.io.files import load_json, save_json
from stad_lab.io.weights import VAE_FILE
from stad_lab.io.workers import interrupted_at_the_end
from stad_lab.training import second_iteration
from stad_lab.training.dataset import MANIFEST, load_manifest, made_with
from stad_lab.training.evolution import LOG
from stad_lab.training.trainer import training_device

RECORD = "record.json"
PACKAGES = (
    "torch", "numpy", "numba", "gymnasium", "box2d", "pygame-ce", "cma", "opencv-python-headless",
    "safetensors",
)  # fmt: skip
MACHINE = ("python", "platform", "processor", "cores", "trained_on")
GIVE_A_RUN = "give the folder of a run, as `python -m stad_lab train --out` makes it"
HEARTBEAT = 30.0  # seconds, after which the record says how long a stage has taken so far


def check_record(folder: Path) -> None:
    """Raise ValueError if a folder is a file, or its record is damaged or of no run."""
    if folder.is_file():
        raise ValueError(f"{folder} is a file: {GIVE_A_RUN}")
    path = folder / RECORD
    record = load_json(path) if path.exists() else {"config": {}}
    if "config" not in record:
        raise ValueError(f"{path} is of {record.get('variant')!r}, no run: choose another folder")


def read_record(folder: Path) -> dict:
    """The record of a run; ValueError if it is damaged, FileNotFoundError if there is none."""
    check_record(folder)
    return load_json(folder / RECORD, GIVE_A_RUN, kind="record")


def read_finished(earlier: Path) -> dict:
    """The record of a run that has finished.

    ValueError if it has not, or a file is damaged; FileNotFoundError if there is no run, or no log.
    """
    record = read_record(earlier)
    log = load_json(earlier / LOG, GIVE_A_RUN, kind="evolution")
    done, asked = len(log["generations"]), log["evolution"]["generations"]
    counted = record.get("budget", {}).get("agents")
    if done != asked or counted != count_agents(log["generations"]):
        found = f"with {done} of {asked} generations: run its own command to the end first"
        raise ValueError(f"the run in {earlier} is not finished, {found}")
    return record


def open_record(config: Config, folder: Path, before: dict | None, made: dict) -> dict:
    """The record of the run in `folder`, or a new one that was made with `made`.

    "earlier" is `before`, the record of the run that this one continues. ValueError if the record
    there is damaged, or V exists and its variant, seed, data or settings differ.
    """
    path = folder / RECORD
    new: dict[str, Any] = {"kind": "record", "variant": config.variant, "config": config.as_dict()}
    if not path.exists():
        earlier = {} if before is None else {"earlier": before}
        return {**new, "made_with": made, "seconds": {}, **earlier}
    record = load_json(path, kind="record")
    if (folder / VAE_FILE).exists():  # then its part of the configuration has not changed
        fixed = {name: new["config"][name] for name in ("variant", "vae")} | made_with(config)
        check_same(path, record["config"], fixed)
    return record | new


def starts(record: dict) -> list[dict]:
    """What a run was made with, and all that it was continued with."""
    return [record["made_with"], *record.get("continued_with", [])]


@contextlib.contextmanager
def timed(record: dict, made: dict, stage: str, folder: Path) -> Iterator[Callable[[], None]]:
    """Yields a function that adds the time of a `with` block to the record, and writes it.

    It also adds `made` to "continued_with", if the last start was made with anything else. A thread
    calls it during a long stage, so that a killed process has left its time.
    """
    before, begin, ended = record["seconds"].get(stage, 0.0), time.perf_counter(), threading.Event()
    alone = threading.Lock()

    def note() -> None:
        with interrupted_at_the_end(), alone:  # or it would be changed while it is written
            record["seconds"][stage] = before + time.perf_counter() - begin
            if made != starts(record)[-1]:
                record["continued_with"] = [*starts(record)[1:], made]
            save_json(folder / RECORD, record)

    def beat() -> None:
        while not ended.wait(HEARTBEAT):
            with contextlib.suppress(OSError):  # a full disk stops the stage itself
                note()

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield note
    finally:
        ended.set()
        thread.join()


def command_of(config: Config) -> str:
    """The command line that makes a run of this configuration."""
    options = {}
    for preset in PRESETS:
        usual = fields_of(Config.preset(preset, variant=config.variant))
        pairs = zip(fields_of(config), usual, strict=True)
        options[preset] = [option_of(ours[0], ours[2]) for ours, other in pairs if ours != other]
    preset = min(options, key=lambda preset: len(options[preset]))
    command = f"python -m stad_lab train {preset} --variant {config.variant} --out ..."
    earlier = ["--earlier ..."] if config.data.agent_episodes else []
    return " ".join([command, *options[preset], *earlier])


def fine_tuning_command(config: Config) -> str:
    """The command line that makes a fine-tuning of this configuration."""
    names = ("generations", "sigma", "seed", "validation_tracks")
    options = [option_of(name, getattr(config.evolution, name)) for name in names]
    return " ".join(["python -m stad_lab fine-tune --run ... --out ...", *options])


def option_of(name: str, value: object) -> str:
    """The command-line option that gives a field its value."""
    stage, dot, field = name.replace("_", "-").rpartition(".")
    if isinstance(value, bool):
        return f"--{stage}{dot}{'' if value else 'no-'}{field}"
    return f"--{stage}{dot}{field} {shlex.quote(str(value))}"


def provenance(command: str) -> dict:
    """What a result was made with: versions, machine, command, and the commit of a checkout."""
    changed = git("status", "--porcelain", "--untracked-files=no", "--", "*.py", ":/stad_*.py")
    return {
        "python": platform.python_version(),
        **{package: importlib.metadata.version(package) for package in PACKAGES},
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": processor(),
        "blas": blas(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),  # the last bits of V and M depend on them
        "trained_on": describe_device(),
        "commit": git("rev-parse", "HEAD"),
        "uncommitted_changes": changed if changed is None else bool(changed),
        "command": command,
    }


def processor() -> str:
    """The processor's name, as far as it is known, and the instructions that PyTorch uses.

    On another one the last bits of a sum may differ, and with them a whole episode.
    """
    listed = Path("/proc/cpuinfo")
    text = listed.read_text() if listed.exists() else ""
    name = text.partition("model name")[2].partition("\n")[0].strip("\t :")
    return f"{name or platform.processor()}, {torch.backends.cpu.get_cpu_capability()}"


def blas() -> str:
    """NumPy's library of matrix products, and the kind of processor that it computes for.

    `OPENBLAS_CORETYPE` can choose another kind, and with it other last bits.
    """
    found = [one for one in threadpool_info() if one["user_api"] == "blas"]
    # OpenCV and SciPy may have loaded others, from folders of their own.
    ours = [one for one in found if "numpy" in "/".join(Path(one["filepath"]).parts[-3:-1])]
    told = {f"{one['internal_api']} {one['version']} {one['architecture']}" for one in ours}
    return "; ".join(sorted(told)) or "unknown"


def describe_device() -> str:
    """What V and M are trained on: "cpu", or "cuda" and the name of the GPU."""
    device = training_device()
    return f"cuda, {torch.cuda.get_device_name(device)}" if device.type == "cuda" else "cpu"


def git(*arguments: str) -> str | None:
    """What git says about this checkout; None without git or if this file is not in a checkout."""
    package, this = Path(__file__).parents[1], "training/record.py"
    try:
        # An environment may lie in the checkout of something else, which does not track this file.
        for command in (["ls-files", "--error-unmatch", this], arguments):
            whole = ["git", "-C", str(package), *command]
            found = subprocess.run(whole, capture_output=True, text=True, check=True)
        return found.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def budget(config: Config, folder: Path, data: Path | None) -> dict:
    """All agents, episodes and frames that were driven for this run, by their purpose.

    "random", "agent_driver", "evolution" and "validation" have "episodes" and "frames"; "agents" is
    a number. Those of an earlier run are in its own record; `total_budget` adds them.
    """
    spent: dict = defaultdict(Counter, random=Counter(episodes=0, frames=0))
    count = config.data.episodes
    again = config.data.agent_episodes > 0
    order = second_iteration.order_of_episodes(config) if again else range(count)
    for entry in load_manifest(data / MANIFEST)["episodes"] if data else ():
        driver = "random" if order[entry["index"]] < count else "agent_driver"
        spent[driver].update(episodes=1, frames=entry["frames"])
    if (folder / LOG).exists():
        generations = load_json(folder / LOG, kind="evolution")["generations"]
        spent["agents"] = count_agents(generations)
        for entry in generations:
            episodes = sum(map(len, entry["returns"]))
            spent["evolution"].update(episodes=episodes, frames=entry["frames"])
            if validation := entry.get("validation"):
                episodes = len(validation["returns"])
                spent["validation"].update(episodes=episodes, frames=validation["frames"])
    return dict(spent)


def count_agents(generations: list[dict]) -> int:
    """How many candidates drove in some generations of CMA-ES."""
    return sum(len(entry["returns"]) for entry in generations)


def total_budget(record: dict) -> dict[str, int]:
    """Agents, episodes and frames of a run, with those of the earlier run that it is built on.

    The random driver's episodes of a second iteration are those of the first and count once.
    """
    parts = [part for part in record["budget"].values() if isinstance(part, dict)]
    total = {unit: sum(part[unit] for part in parts) for unit in ("episodes", "frames")}
    total["agents"] = record["budget"].get("agents", 0)
    if "earlier" in record:
        before = total_budget(record["earlier"])
        random = [made_with(Config.from_dict(one["config"])) for one in (record, record["earlier"])]
        for one in random:
            one["data"] = {k: v for k, v in one["data"].items() if not k.startswith("agent_")}
        again = record["budget"]["random"] if random[0] == random[1] else {}
        total = {unit: n + before[unit] - again.get(unit, 0) for unit, n in total.items()}
    return total
