"""The dataset: episodes of a random driver, collected in parallel and kept on disk.

A folder holds two files for each episode, `00042.frames.npy` (uint8) and `00042.actions.npy`
(float32), and `manifest.json` with the configuration and all checksums. An episode enters the
manifest when its files are complete, so an interrupted collection continues. Frames are read when
they are needed: a dataset may be larger than the memory.
"""

import dataclasses
import io
import json
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from stad_lab.agent import Driver, rollout
from stad_lab.config import Config, check_same, random_stream, track_seeds
from stad_lab.envs.cars import Cars
from stad_lab.envs.frames import FRAME_SIZE, earlier_index
from stad_lab.io.files import checksum, load_json, locked, read_bytes, save_json, write_bytes
from stad_lab.io.workers import run_tasks, worker_threads

MANIFEST = "manifest.json"
NPY_HEADER = 128  # bytes before the array in a file of np.save, for an array of a few dimensions
UNWRITTEN = 1e9  # bytes of episodes that may wait for the disk
FRAME_BYTES = FRAME_SIZE**2 * 3 + 3 * 4  # of a frame and its action on the disk
HELDOUT = 20  # one in so many episodes, the last ones, is held out from training

Episode = tuple[np.ndarray, np.ndarray, int]
"""Frames uint8 (T, 64, 64, 3), actions float32 (T, 3) and the seed of the track."""


class RandomDriver:
    """Drives one car without looking: smooth random steering and gas, and rare braking.

    Steering is a mean-reverting random walk (Ornstein-Uhlenbeck); gas varies around 0.35.
    """

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self.steering, self.gas, self.brake_frames = 0.0, 0.35, 0

    def act(self) -> np.ndarray:
        """The next action, float32 (3,): steering in [-1, 1], gas and brake in [0, 1]."""
        self.steering += -0.1 * self.steering + 0.2 * self.rng.standard_normal()
        self.gas += 0.05 * (0.35 - self.gas) + 0.08 * self.rng.standard_normal()
        self.brake_frames = max(0, self.brake_frames - 1)
        if self.rng.random() < 0.01:
            self.brake_frames = int(self.rng.integers(5, 20))
        brake = 0.4 if self.brake_frames else 0.0
        action = [np.clip(self.steering, -1, 1), np.clip(self.gas, 0, 1) * (not brake), brake]
        return np.array(action, np.float32)

    def act_batch(self, seen: np.ndarray) -> np.ndarray:
        """The action of the only car, float32 (1, 3)."""
        return self.act()[None]

    def keep(self, cars: np.ndarray) -> None:
        """There is one car."""


def random_start(
    config: Config, index: int, use: str = "collect", shows: str = "frame"
) -> tuple[Cars, RandomDriver]:
    """A car where episode `index` of the random driver begins, and the driver.

    A share `data.random_starts` of the episodes begins moving on a random tile; otherwise the data
    would hold little but the first bend and grass. `index` is below `data.episodes`, `use` a key of
    TRACK_RANGES, `shows` what the car sees, as for `Cars`.
    """
    rng = random_stream("random driver", config.seed, index)
    cars = Cars(1, shows, bar=shows == "observation" or not config.data.crop_bar)
    cars.reset([track_seeds(use, config.data.episodes, config.seed)[index]])
    if rng.random() < config.data.random_starts:
        tile, speed, turn = int(rng.integers(10_000)), rng.uniform(0, 90), rng.standard_normal()
        cars.place(0, tile=tile, speed=speed, turn=0.15 * turn, offset=rng.uniform(-0.7, 0.7))
    return cars, RandomDriver(rng)


def drive_randomly(config: Config, index: int) -> Episode:
    """Drive episode `index` of the random driver. Runs in a worker."""
    cars, driver = random_start(config, index)
    pair = record_frames(driver, cars, max_frames=config.data.episode_frames)
    return *pair, cars.seeds[0]


def record_frames(driver: Driver, cars: Cars, **limits) -> tuple[np.ndarray, np.ndarray]:
    """Drive one episode; returns frames and actions as in `Episode`. `limits` are of `rollout`."""
    frames, actions = [], []

    def observe(_: np.ndarray, seen: np.ndarray, action: np.ndarray) -> None:
        frames.append(seen[0])
        actions.append(action[0])

    rollout(driver, cars, observe=observe, **limits)
    return np.array(frames), np.array(actions)


def collect(config: Config, folder: Path, executor: Executor | None = None) -> bool:
    """Collect the random driver's missing episodes into `folder`; False if there are none.

    Args:
        executor: where episodes run; None for `config.processes` threads of this machine.

    Raises:
        ValueError: the folder holds a dataset of another configuration, or a damaged manifest.
        OSError: the disk has not enough space, or another process works in the folder.
        TaskError: an episode failed.
    """
    tasks = [(config, index) for index in range(config.data.episodes)]
    longest = [config.data.episode_frames] * len(tasks)
    with worker_threads(config.processes, executor) as executor:
        return collect_episodes(folder, made_with(config), drive_randomly, tasks, longest, executor)


def made_with(config: Config) -> dict:
    """What the random driver's episodes depend on."""
    data = dataclasses.asdict(config.data)
    if not config.data.agent_episodes:
        del data["agent_frames"], data["agent_patience"]
    return {"seed": config.seed, "data": data}


def collect_episodes(
    folder: Path,
    made_with: dict,
    drive_episode: Callable[..., Episode],
    tasks: list[tuple],
    longest: list[int],
    executor: Executor,
) -> bool:
    """Drive the episodes that are not in `folder` yet, one for each task; False if there are none.

    Args:
        made_with: what the dataset depends on; a folder of another one is refused.
        longest: frames that each episode has at most.

    Raises as `collect`.
    """
    folder = Path(folder)
    if len(read_manifest(folder, made_with)["episodes"]) == len(tasks):
        return False
    with locked(folder):
        manifest = read_manifest(folder, made_with)  # another process may have collected until now
        done = {entry["index"] for entry in manifest["episodes"]}
        missing = [index for index in range(len(tasks)) if index not in done]
        check_disk(folder, sum(longest[index] for index in missing) * FRAME_BYTES)
        ahead = max(8, int(UNWRITTEN / (max(longest) * FRAME_BYTES)))
        found = run_tasks(executor, drive_episode, [tasks[i] for i in missing], ahead=ahead)
        save_json(folder / MANIFEST, manifest)
        bar = tqdm(found, "collect", len(tasks), initial=len(done), unit="episode")
        for number, episode in bar:
            manifest["episodes"].append(save_episode(folder, missing[number], episode))
            manifest["episodes"].sort(key=lambda entry: entry["index"])
            save_json(folder / MANIFEST, manifest)
    return bool(missing)


def save_episode(folder: Path, index: int, episode: Episode) -> dict:
    """Write the files of an episode; returns its entry in the manifest."""
    frames, actions, track = episode
    entry: dict[str, int | str] = {"index": index, "track": track, "frames": len(frames)}
    for name, array in (("frames", frames), ("actions", actions)):
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=False)
        write_bytes(episode_file(folder, index, name), buffer.getbuffer())
        entry[f"{name}_sha256"] = checksum(buffer.getbuffer())
    return entry


def episode_file(folder: Path, index: int, name: str) -> Path:
    """The file of the array `name` ("frames" or "actions") of an episode."""
    return folder / f"{index:05d}.{name}.npy"


def read_manifest(folder: Path, made_with: dict) -> dict:
    """The manifest in `folder`, or a new one. ValueError if damaged or of another dataset."""
    path = folder / MANIFEST
    if not path.exists():
        return {"kind": "dataset", "made_with": made_with, "episodes": []}
    manifest = load_manifest(path)
    check_same(path, manifest["made_with"], made_with)
    return manifest


def load_manifest(path: Path, remedy: str = "collect again") -> dict:
    """Read a manifest. Arguments and errors are those of `load_json`."""
    return load_json(path, remedy, kind="dataset")


def check_disk(folder: Path, needed: int) -> None:
    """Print how much space `needed` bytes are; OSError, before any work, if it is not free."""
    free = shutil.disk_usage(folder).free
    space = f"dataset: up to {needed / 1e9:.2f} GB in {folder}, {free / 1e9:.2f} GB are free"
    if needed > free:
        raise OSError(f"{space}: free some space, or collect fewer or shorter episodes")
    print(space)


class EpisodeFrames(Sequence):
    """The frames of every episode, uint8 (T, 64, 64, 3), read from the disk at every access."""

    def __init__(self, paths: list[Path]):
        self.paths = paths  # not memory-mapped: that counts as our memory once it is touched

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:  # type: ignore[override]  # no slices
        return np.load(self.paths[index], allow_pickle=False)

    def read(self, index: int, moments: list[int], into: list[np.ndarray]) -> None:
        """Read single frames into arrays uint8 (64, 64, 3). ValueError if the file is too short."""
        with self.paths[index].open("rb", buffering=0) as file:
            for moment, frame in zip(moments, into, strict=True):
                file.seek(NPY_HEADER + moment * frame.nbytes)
                if file.readinto(frame.data) < frame.nbytes:
                    raise ValueError(f"{self.paths[index]} was cut short: collect in a new folder")


class Dataset:
    """The dataset in a folder, read-only. Opening it checks every file once.

    Attributes:
        frames: uint8 (T, 64, 64, 3) for each episode, read at every access.
        actions: float32 (T, 3) for each episode.
        episode, moment: int64 (frames,), the episode of every frame, and its number there.
        checksum: of the whole dataset; V keeps that of the one it was trained on.

    Raises:
        FileNotFoundError, ValueError: it is missing, incomplete or damaged.
    """

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        remedy = f"collect it first: python -m stad_lab train ... --dataset {self.folder}"
        self.manifest = load_manifest(self.folder / MANIFEST, remedy)
        found, wanted = count_episodes(self.manifest)
        if found != wanted:
            raise ValueError(f"{self.folder} holds {found} of {wanted} episodes: {remedy}")
        entries = self.manifest["episodes"]
        self.checksum = dataset_checksum(self.manifest)
        for entry in entries:
            self._read(entry, "frames", (FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
        paths = [episode_file(self.folder, entry["index"], "frames") for entry in entries]
        self.frames = EpisodeFrames(paths)
        self.actions = [self._read(entry, "actions", (3,), np.float32) for entry in entries]
        lengths = [entry["frames"] for entry in entries]
        self.episode = np.repeat(np.arange(len(lengths)), lengths)  # of every frame in the dataset
        self.moment = np.concatenate([np.arange(length) for length in lengths])

    def _read(self, entry: dict, name: str, shape: tuple[int, ...], dtype) -> np.ndarray:
        path, shape = episode_file(self.folder, entry["index"], name), (entry["frames"], *shape)
        remedy = f"delete {self.folder} and collect again"
        content = read_bytes(path, remedy)
        if checksum(content) != entry[f"{name}_sha256"]:
            raise ValueError(f"{path} is damaged, its checksum is not the manifest's: {remedy}")
        array = np.load(io.BytesIO(content), allow_pickle=False)
        if array.shape != shape or array.dtype != dtype:
            found = f"{array.dtype} {array.shape}"
            raise ValueError(f"{path} holds {found}, the manifest says {shape}: {remedy}")
        return array

    def __len__(self) -> int:
        return len(self.episode)

    def pairs(self, indices: np.ndarray, stride: int) -> tuple[np.ndarray, np.ndarray]:
        """Frames by their indices (n,) and those to subtract: uint8 (n, 64, 64, 3) each."""
        episodes, moments = self.episode[indices], self.moment[indices]
        before = earlier_index(moments, stride)
        frames, earlier = np.empty((2, len(indices), FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
        for place, episode in enumerate(episodes):
            into = [frames[place], earlier[place]]
            self.frames.read(episode, [moments[place], before[place]], into)
        return frames, earlier

    @property
    def first_heldout(self) -> int:
        """Index of the first held-out episode; it and all later ones are kept from training."""
        return len(self.frames) - max(1, round(len(self.frames) / HELDOUT))

    def split(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the training frames and of the held-out frames."""
        heldout = self.episode >= self.first_heldout
        return np.flatnonzero(~heldout), np.flatnonzero(heldout)


def count_episodes(manifest: dict) -> tuple[int, int]:
    """How many episodes a manifest lists, and how many there are to be."""
    data = manifest["made_with"]["data"]
    return len(manifest["episodes"]), data["episodes"] + data.get("agent_episodes", 0)


def dataset_checksum(manifest: dict) -> str:
    """SHA-256 of a manifest's entries, which hold the checksums of all files."""
    return checksum(json.dumps(manifest["episodes"]).encode())


def check_seen(path: Path, seen: str | None, folder: Path) -> None:
    """Raise ValueError if the weights in `path` were trained on another dataset than `folder`'s.

    `seen` is the checksum of the dataset that they were trained on, or None if it is not known. A
    dataset that is not complete has none to compare.
    """
    if not seen or not (file := Path(folder) / MANIFEST).exists():
        return
    manifest = load_manifest(file)
    found, wanted = count_episodes(manifest)
    if found == wanted and seen != dataset_checksum(manifest):
        raise ValueError(f"{path} was trained on another dataset than {folder}: give its own one")
