"""The replication: every row of its table, made by one command.

`replicate` trains V and M once, searches for C once for each seed, and drives every C found on the official tracks. In
the folder of a row of `stad_lab.replication.experiments`::

    first/      in a recipe of two rounds: the whole first run
    world/      rollouts, V and M
    seed0/ ...  V, M and C of one search, with its log, record.json and evaluation.json

A row of finishes has neither a first round nor a world, because it goes on from the seeds of another row. In a
`retrained` row every seed is a whole run, with a V and an M of its own. The rows of FLOORS are drivers that do not look
at the road. Whatever is there already is not done again.
"""

import dataclasses
import filecmp
import shutil
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from stad_lab.agent import CONTROLLER
from stad_lab.benchmark import save_pair, train_m, train_v
from stad_lab.config import Settings, check_same_run
from stad_lab.envs.car_racing import MAX_FRAMES, make_env
from stad_lab.evaluation.evaluate import SOLVED, evaluate, report
from stad_lab.io.files import checksum, copy_file, load_json, load_tensors, save_json
from stad_lab.io.workers import run_in_order, work_alone, worker_processes
from stad_lab.models.controller import initial_parameters, squash
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import AutoEncoder
from stad_lab.replication.experiments import ROWS, Row, find_row, is_floor
from stad_lab.replication.tables import RECORDS, TOP, seed_folders, summarise_row, worlds
from stad_lab.training.dataset import RandomDriver, collect_rollouts
from stad_lab.training.evolution import LOG, drive_generation
from stad_lab.training.fine_tuning import finish
from stad_lab.training.pipeline import provenance, train
from stad_lab.training.subspace import COMPONENTS, START

KEPT = ("record.json", LOG, "evaluation.json", CONTROLLER)  # of every run, as far as it has them
TRACKS = 100  # official tracks, those of the seeds 0 to 99, on which every C is reported


def replicate(
    name: str,
    folder: str | Path,
    executor: Executor | None = None,
    seeds: Sequence[int] | None = None,
) -> dict:
    """Make one row of the table, or what is missing of it; run it again after an interrupt to go on.

    Args:
        name: one of ROWS or FLOORS.
        folder: of all rows; this one goes into `folder/name`.
        executor: who drives; None for processes of this machine.
        seeds: some of the row's seeds; None for all. A floor has none.

    Returns:
        What `summarise_row` makes of these seeds.

    Raises:
        ValueError: an unknown row or seed, or a folder with something else in it.
        OSError, TaskError, FloatingPointError: as `train` and `evaluate`.
    """
    if is_floor(name, seeds):
        return drive_floor(name, Path(folder) / name / "seed0", executor)
    row, folder = find_row(name, seeds), Path(folder)
    folders = {seed: folder / name / f"seed{seed}" for seed in row.seeds}
    if row.base:
        finish_row(row, folder, folders, executor)
    elif row.retrained:
        for seed, own in folders.items():
            train(row.variant, row.settings_of(seed), own, executor=executor)
            evaluate_row(row, own, executor)
    else:
        first, world = make_world(
            ROWS[row.world] if row.world else row, folder / (row.world or name), executor
        )
        for seed, own in folders.items():
            search(row, seed, own, first, world, executor)
    return summarise_row(list(folders.values()))


def drive_floor(name: str, folder: Path, executor: Executor | None) -> dict:
    """Drive the official tracks without looking, and write `evaluation.json` and a record."""
    if not (folder / "evaluation.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        begin, tracks = time.perf_counter(), list(range(TRACKS))
        with worker_processes(Settings().processes, executor) as executor:
            driven = run_in_order(
                executor, drive_blindly, [(name, track) for track in tracks], name
            )
        returns, lengths = (np.array(part) for part in zip(*driven, strict=True))
        told = {"variant": name, "renderer": "none: it does not look"} | report(
            tracks, returns, lengths
        )
        record = {
            "variant": name,
            "made_with": provenance(f"python -m stad_lab replicate --row {name} --out ..."),
        }
        save_json(folder / "record.json", record | {"budget": {}})
        save_json(folder / "evaluation.json", told | {"seconds": time.perf_counter() - begin})
    return summarise_row([folder])


def drive_blindly(name: str, track: int) -> tuple[float, int]:
    """Drive an official track as a row of FLOORS: (return, frames). Runs in a worker process.

    Rewards do not depend on the renderer, so the fast one serves.
    """
    work_alone()
    driver = RandomDriver(np.random.default_rng([0, track]))
    gentle = squash(np.array([0.0, Settings().initial_gas, 0.0]))
    env = make_env(fast=True)
    env.reset(seed=track)
    total, frames, ended = 0.0, 0, False
    while not ended:
        action = driver.act() if name == "random_driver" else gentle
        _, reward, terminated, truncated, _ = env.step(action.astype(np.float32))
        total, frames, ended = total + reward, frames + 1, terminated or truncated
    env.close()
    return total, frames


def finish_row(row: Row, folder: Path, folders: dict[int, Path], executor: Executor | None) -> None:
    """Make the finishes of a row, seed -> folder, and those seeds of its base that are not there."""
    for seed, own in folders.items():
        base = folder / row.base / own.name
        if not (base / "evaluation.json").exists():
            replicate(row.base, folder, executor, [seed])
        searches = [one.settings_of(seed) for one in (ROWS[row.base], row)]
        check_same_run(base, load_json(base / "record.json")["settings"], searches[0].as_dict())
        finish(row.variant, searches[1], base, own, executor)
        evaluate_row(row, own, executor)


def make_world(row: Row, folder: Path, executor: Executor | None) -> tuple[Path | None, Path]:
    """Make a row's rollouts, V and M, and before them its first round: the folders of both."""
    first, world = folder / "first" if row.first else None, folder / "world"
    if row.first:
        train(row.variant, row.first, first, executor=executor)
    train(row.variant, row.settings, world, until="mdn_rnn", executor=executor, earlier=first)
    return first, world


def search(
    row: Row, seed: int, folder: Path, first: Path | None, world: Path, executor: Executor | None
) -> None:
    """Search for C with one seed, and drive what was found on the official tracks.

    Where a search begins, and along which components, depends on the world alone: the first seed finds it for all,
    but for a seed from elsewhere, with V and M of another training.
    """
    folder.mkdir(parents=True, exist_ok=True)
    trained = ("autoencoder", "mdn_rnn") if row.settings.m_steps else ("autoencoder",)
    made = [world / f"{part}.safetensors" for part in trained]
    alike = [
        seed
        for seed in seed_folders(folder.parent)
        if all(same_file(seed / file.name, file) for file in made)
    ]
    found = [
        seed / name for seed in alike for name in (COMPONENTS, START) if (seed / name).exists()
    ]
    for source in made + found:
        if not (folder / source.name).exists():
            copy_file(source, folder)
    train(
        row.variant,
        row.settings_of(seed),
        folder,
        world / "rollouts",
        executor=executor,
        earlier=first,
    )
    evaluate_row(row, folder, executor)


def same_file(one: Path, other: Path) -> bool:
    """Whether both files are there and hold the same bytes."""
    return one.exists() and other.exists() and filecmp.cmp(one, other, shallow=False)


def evaluate_row(row: Row, folder: Path, executor: Executor | None) -> None:
    """Drive what a search found on the official tracks, and write `evaluation.json`, if that does not tell of it."""
    path, found = folder / "evaluation.json", checksum((folder / CONTROLLER).read_bytes())
    if (
        not path.exists()
        or load_json(path, "run the same command again")["controller_sha256"] != found
    ):
        unfinished = folder / "unfinished-evaluation.json"
        save_json(
            path, evaluate(row.variant, folder, TRACKS, executor=executor, unfinished=unfinished)
        )
        unfinished.unlink(missing_ok=True)


def keep(
    name: str, folder: str | Path, target: Path = RECORDS, seeds: Sequence[int] | None = None
) -> list[Path]:
    """Copy the records of a row's finished seeds to where the notebooks look for them; returns their new folders.

    With them go the records and the losses of the first round and of the world, if the row has its own. Seeds that are
    made elsewhere, in a folder without seed 0, may have V and M from another training by the same settings. If so, the
    records of that one go to `first_of_seed1` and `world_of_seed1`, by the first of these seeds; if not, they are there
    already, or come with seed 0 and replace those.

    Args:
        seeds: as of `replicate`.
    """
    kept = []
    for seed in (0,) if is_floor(name, seeds) else find_row(name, seeds).seeds:
        source = Path(folder) / name / f"seed{seed}"
        if (source / "evaluation.json").exists():
            kept.append(target / name / source.name)
            copy_records(source, kept[-1])
    seed_0 = Path(folder) / name / "seed0"
    with_seed_0 = bool(kept) and (seed_0 / "evaluation.json").exists()
    known = worlds(kept) <= worlds(
        [path for path in seed_folders(target / name) if path not in kept]
    )
    for part in ("first", "world"):
        if (Path(folder) / name / part).exists() and (with_seed_0 or not known):
            own = part if with_seed_0 else f"{part}_of_{kept[0].name}"
            copy_records(Path(folder) / name / part, target / name / own)
            keep_histories(Path(folder) / name / part, target / name / own)
    if with_seed_0:
        remove_twins(target / name, seed_0)
    return kept


def remove_twins(row: Path, seed_0: Path) -> None:
    """Remove the records of a training that was kept under a later seed's name and is that of seed 0, too."""
    for twin in [*row.glob("first_of_seed*"), *row.glob("world_of_seed*")]:
        _, seed = twin.name.split("_of_")
        if worlds([row / seed]) == worlds([seed_0]):
            shutil.rmtree(twin)


def keep_histories(source: Path, target: Path) -> None:
    """Write how the losses of V and M went, which their weights tell and which stay behind: `histories.json`."""
    files = {part: source / f"{part}.safetensors" for part in ("autoencoder", "mdn_rnn")}
    save_json(
        target / "histories.json",
        {part: load_tensors(file)[1]["history"] for part, file in files.items()},
    )


def copy_records(source: Path, target: Path) -> None:
    """Copy a run's records, as far as it has them."""
    for file in KEPT:
        if (source / file).exists():
            copy_file(source / file, target)


def time_needed(name: str, seeds: Sequence[int] | None = None) -> dict[str, float]:
    """How long a row, or some of its seeds, takes on this machine, in seconds: what it is for -> time.

    Measures for about half a minute.

    An agent's episode is taken to have as many frames as it may have at most, so the searches may be quicker.
    """
    if is_floor(name, seeds):
        return {"evaluations": TRACKS * MAX_FRAMES / (Settings().processes * blind_speed(name))}
    row = find_row(name, seeds)
    if row.base:
        times, before = time_needed(row.base, row.seeds), ROWS[row.base].settings
        longer = most_frames(row.settings) / most_frames(before)
        return times | {
            "finishes": times["searches"] * longer,
            "evaluations": 2 * times["evaluations"],
        }
    with tempfile.TemporaryDirectory() as folder:
        speed = speeds(row, Path(folder))
    made = ROWS[row.world] if row.world else row
    rounds = (
        [made.first, made.settings]
        if made.first
        else [made.settings] * (len(row.seeds) if row.retrained else 1)
    )
    return {
        "rollouts": sum(
            s.episodes * s.episode_frames + s.agent_episodes * s.max_frames for s in rounds
        )
        / speed["V, M, C"],
        "V": sum(s.v_steps * s.v_batch for s in rounds) / speed["V"],
        "M": sum(s.m_steps * s.m_batch * s.m_sequence for s in rounds) / speed["M"],
        "first search": most_frames(row.first) / speed["V, M, C"] if row.first else 0.0,
        "searches": len(row.seeds) * most_frames(row.settings) / speed["V, M, C"],
        "evaluations": len(row.seeds) * TRACKS * MAX_FRAMES / speed["official"],
    }


def most_frames(settings: Settings) -> int:
    """How many frames a search for C drives at most, with its looks at the validation tracks."""
    looks = settings.generations // settings.validate_every * settings.validation_tracks
    return (
        settings.generations * settings.population * settings.tracks + looks
    ) * settings.max_frames


def speeds(row: Row, folder: Path) -> dict[str, float]:
    """What this machine does in a second: frames driven with V, M and C, images of V, frames of M, official frames."""
    settings, length = row.settings, 60
    collect_rollouts(Settings.preset("quick"), folder / "rollouts")
    mdn_rnn = MDNRNN(settings.latent_size, settings.hidden_size, settings.mixtures)
    autoencoder = AutoEncoder(row.variant, settings.latent_size, settings.width)
    save_pair(folder, autoencoder, mdn_rnn, settings)
    brief = dataclasses.replace(settings, max_frames=length)
    start = initial_parameters(settings.latent_size, settings.hidden_size, settings.initial_gas)
    with worker_processes(settings.processes) as executor:
        for _ in range(2):  # the first time workers start
            begin = time.perf_counter()
            entry = drive_generation(
                executor, folder, row.variant, brief, [], np.tile(start, (settings.population, 1))
            )
            driven = entry["frames"] / (time.perf_counter() - begin)
    env = make_env(fast=False)
    env.reset(seed=0)
    begin = time.perf_counter()
    for _ in range(length):
        env.step(np.array([0.0, 0.1, 0.0], np.float32))
    official = length / (time.perf_counter() - begin)
    env.close()
    return {
        "V, M, C": driven,
        "official": settings.processes * official,
        "V": train_v(False, settings.width, folder / "rollouts", 0, steps=12)[0],
        "M": train_m(False, 0, steps=6, batch=settings.m_batch // 4),
    }


def blind_speed(name: str) -> float:
    """Frames a second that a driver of FLOORS drives here."""
    begin = time.perf_counter()
    return drive_blindly(name, 0)[1] / (time.perf_counter() - begin)


def describe_time(name: str, times: dict[str, float]) -> str:
    """One line that says how long a row takes."""
    parts = ", ".join(
        f"{part} {seconds / 60:.0f} min" for part, seconds in times.items() if seconds
    )
    return f"{name}: at most {sum(times.values()) / 3600:.1f} hours on this machine, if nothing of it is there ({parts})"


def describe_row(name: str, found: dict) -> str:
    """One line of the table."""
    low, high = found["interval"]
    return (
        f"{name}: {found['mean']:.1f} +- {found['standard_deviation']:.0f} on {TRACKS} official tracks"
        f" ({len(found['seeds'])} seeds), 95% interval of the mean {low:.0f} to {high:.0f},"
        f" {100 * found['above_900']:.0f}% above {SOLVED}, best {TOP} {found['top_90']:.1f};"
        f" a seed cost {found['agents']:.0f} agents, {found['episodes']:.0f} episodes"
    )
