"""Rollouts: a random driver collects episodes, in parallel, into a dataset on disk.

A folder of rollouts holds one block for each episode, `00042.frames.npy` (uint8) and `00042.actions.npy` (float32), and
`manifest.json` with the settings, and for each block its track, length and checksums. A block enters the manifest only
when it is complete on disk, so an interrupted collection goes on where it stopped. Frames are read when they are needed
and not kept: a dataset may be larger than the memory (at `paper` settings it has 12 GB).
"""

import io
import json
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from pathlib import Path

import gymnasium as gym
import numpy as np
from tqdm.auto import tqdm

from stad_lab.config import Settings
from stad_lab.envs.car_racing import make_env, place_car
from stad_lab.envs.frames import FRAME_SIZE, earlier_index, to_frame
from stad_lab.io.files import checksum, load_json, locked, read_bytes, save_json, write_bytes
from stad_lab.io.workers import run_tasks, work_alone, worker_processes

# Tracks are named by the seed of `env.reset`. The uses never share one: an agent is reported on tracks that nothing was
# trained or chosen on, and what V and M know is measured on tracks that they have not seen.
TRACK_RANGES = {
    "test": (0, 1_000_000),
    "collect": (1_000_000, 2_000_000),
    "evolve": (2_000_000, 3_000_000),
    "validate": (3_000_000, 4_000_000),
    "inspect": (4_000_000, 5_000_000),
}
NPY_HEADER = 128  # bytes before the array in a file of np.save, where the array's shape is short
MANIFEST = "manifest.json"
UNWRITTEN = 1e9  # bytes of episodes that may wait for the disk
FRAME_BYTES = FRAME_SIZE**2 * 3 + 3 * 4  # of a frame and its action on the disk
COLLECT_SETTINGS = (
    "seed",
    "crop_bar",
    "episodes",
    "episode_frames",
    "random_starts",
)  # what a dataset depends on
AGENT_SETTINGS = ("agent_episodes", "max_frames", "patience")  # and if an agent drives for it, too


def track_seeds(use: str, count: int, *seed: int) -> list[int]:
    """Seeds of `count` tracks for one use, drawn from that use's own range with the random seed `seed`."""
    low, high = TRACK_RANGES[use]
    return (
        np.random.default_rng([list(TRACK_RANGES).index(use), *seed])
        .integers(low, high, count)
        .tolist()
    )


class RandomDriver:
    """Drives without looking: smooth random steering that returns to the middle, gentle gas, a rare brake.

    Steering is a mean-reverting random walk (an Ornstein-Uhlenbeck process); gas wanders around 0.35.
    """

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
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


def begin_randomly(
    settings: Settings, index: int, use: str = "collect"
) -> tuple[gym.Env, np.ndarray, RandomDriver]:
    """Put the car where the random driver's episode number `index` begins.

    Most episodes start moving on a random tile, or the data would be nothing but the first bend and then grass.

    Args:
        use: whose tracks to take, a key of TRACK_RANGES.

    Returns:
        The environment, its first observation, uint8 (96, 96, 3), and the driver.
    """
    rng = np.random.default_rng([settings.seed, index])
    env = make_env(fast=True, bar=use != "collect" or not settings.crop_bar)
    observation, _ = env.reset(seed=track_seeds(use, settings.episodes, settings.seed)[index])
    if rng.random() < settings.random_starts:
        observation = place_car(
            env,
            tile=int(rng.integers(10_000)),
            speed=rng.uniform(0, 90),
            turn=0.15 * rng.standard_normal(),
            offset=rng.uniform(-0.7, 0.7),
        )
    return env, observation, RandomDriver(rng)


def drive_randomly(settings: Settings, index: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Drive episode number `index`: (frames uint8 (T, 64, 64, 3), actions float32 (T, 3), track seed).

    `actions[t]` is what the driver does on seeing `frames[t]`. Runs in a worker process.
    """
    work_alone()
    env, observation, driver = begin_randomly(settings, index)
    frames, actions = [], []
    for _ in range(settings.episode_frames):
        frames.append(to_frame(observation, settings.crop_bar))
        actions.append(driver.act())
        observation, _, terminated, truncated, _ = env.step(actions[-1])
        if terminated or truncated:
            break
    env.close()
    return (
        np.array(frames),
        np.array(actions),
        track_seeds("collect", settings.episodes, settings.seed)[index],
    )


def save_block(
    folder: Path, index: int, frames: np.ndarray, actions: np.ndarray, track: int
) -> dict:
    """Write an episode's block; returns its entry for the manifest."""
    entry = {"index": index, "track": track, "frames": len(frames)}
    for name, array in (("frames", frames), ("actions", actions)):
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=False)
        write_bytes(block_path(folder, index, name), buffer.getbuffer())
        entry[f"{name}_sha256"] = checksum(buffer.getbuffer())
    return entry


def block_path(folder: Path, index: int, name: str) -> Path:
    """Where the array `name` ("frames" or "actions") of block `index` lies."""
    return folder / f"{index:05d}.{name}.npy"


def collect_rollouts(settings: Settings, folder: Path, executor: Executor | None = None) -> bool:
    """Collect the random driver's episodes into `folder`; goes on where an earlier call stopped.

    Args:
        executor: who drives; None for `settings.processes` processes of this machine. Only this process writes.

    Returns:
        False if everything was there already, True if something was collected.

    Raises:
        ValueError: the folder holds rollouts of other settings.
        OSError: the disk has not enough room for them, or another process works in the folder.
        TaskError: an episode failed.
    """
    made_with = {field: getattr(settings, field) for field in COLLECT_SETTINGS}
    tasks = [(settings, index) for index in range(settings.episodes)]
    with worker_processes(settings.processes, executor) as executor:
        return collect(
            folder,
            made_with,
            drive_randomly,
            tasks,
            [settings.episode_frames] * len(tasks),
            executor,
        )


def collect(
    folder: Path,
    made_with: dict,
    drive_episode: Callable,
    tasks: list[tuple],
    longest: list[int],
    executor: Executor,
) -> bool:
    """Drive the episodes that are not in `folder` yet, one for each task, and write their blocks.

    Args:
        made_with: what the dataset depends on; it is kept in the manifest, and a folder of another one is refused.
        drive_episode: called with a task, it returns frames, actions and track as `drive_randomly`.
        longest: frames that each episode has at most.

    Returns, and raises, as `collect_rollouts`.
    """
    folder = Path(folder)
    if len(read_manifest(folder, made_with)["blocks"]) == len(tasks):
        return False
    with locked(folder):
        manifest = read_manifest(
            folder, made_with
        )  # again: another process may have collected until now
        done = {entry["index"] for entry in manifest["blocks"]}
        missing = [index for index in range(len(tasks)) if index not in done]
        if not missing:
            return False
        check_disk(folder, sum(longest[index] for index in missing) * FRAME_BYTES)
        save_json(folder / MANIFEST, manifest)
        ahead = max(8, int(UNWRITTEN / (max(longest) * FRAME_BYTES)))
        episodes = run_tasks(
            executor, drive_episode, [tasks[index] for index in missing], ahead=ahead
        )
        for number, episode in tqdm(
            episodes, "collect", len(tasks), initial=len(done), unit="episode"
        ):
            entry = save_block(folder, missing[number], *episode)
            manifest["blocks"] = sorted(
                [*manifest["blocks"], entry], key=lambda entry: entry["index"]
            )
            save_json(folder / MANIFEST, manifest)
    return True


def read_manifest(folder: Path, made_with: dict) -> dict:
    """The manifest of the rollouts in `folder`, or a new one. ValueError if it is damaged, or of other settings."""
    path = folder / MANIFEST
    manifest = load_json(path) if path.exists() else {"settings": made_with, "blocks": []}
    if manifest["settings"] != made_with:
        raise ValueError(
            f"{folder} holds rollouts collected with {manifest['settings']}, and now {made_with} is asked for:"
            " choose another folder or the same settings"
        )
    return manifest


def check_disk(folder: Path, needed: int) -> None:
    """Say how much of the disk `needed` bytes are, and raise OSError, before any work, if so much is not free."""
    free = shutil.disk_usage(folder).free
    room = f"rollouts: up to {needed / 1e9:.2f} GB in {folder}, where {free / 1e9:.2f} GB are free"
    if needed > free:
        raise OSError(
            f"{room}: free some room, choose a folder on another disk, or collect fewer or shorter episodes"
        )
    print(room)


class EpisodeFrames(Sequence):
    """The frames of every episode, uint8 (T, 64, 64, 3) each, read from the disk when asked for and not kept.

    Memory-mapped files would be shorter to write, but all that was ever touched of them counts as the process's memory.
    """

    def __init__(self, paths: list[Path]):
        self.paths = paths

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:
        return np.load(self.paths[index], allow_pickle=False)

    def read(self, index: int, moments: list[int], into: list[np.ndarray]) -> None:
        """Read single frames of episode `index` into arrays uint8 (64, 64, 3). ValueError if the file was cut short."""
        with self.paths[index].open("rb", buffering=0) as file:
            for moment, frame in zip(moments, into, strict=True):
                file.seek(NPY_HEADER + moment * frame.nbytes)
                if file.readinto(frame.data) < frame.nbytes:
                    raise ValueError(
                        f"{self.paths[index]} is shorter than it was: collect in another folder"
                    )


def count_episodes(manifest: dict) -> tuple[int, int]:
    """How many episodes a manifest lists, and how many there are to be."""
    made_with = manifest["settings"]
    return len(manifest["blocks"]), made_with["episodes"] + made_with.get("agent_episodes", 0)


def identity_of(manifest: dict) -> str:
    """The checksum of a whole dataset."""
    return checksum(json.dumps(manifest["blocks"]).encode())


def check_seen(path: Path, seen: str | None, folder: Path) -> None:
    """Raise ValueError if the weights in `path` have seen other rollouts than those in `folder`, as far as both tell.

    Args:
        seen: identity of the rollouts that they were trained on; None if that is not known.
    """
    manifest = Path(folder) / MANIFEST
    if seen and manifest.exists() and seen != identity_of(load_json(manifest)):
        raise ValueError(
            f"{path} was trained on other rollouts than those in {folder}: give its own ones"
        )


class Rollouts:
    """The dataset in a folder, read-only.

    Attributes:
        frames: one uint8 array (T, 64, 64, 3) for each episode, read from the disk at every access.
        actions: one float32 array (T, 3) for each episode.
        identity: checksum of the whole dataset; what was trained on it keeps it.

    Raises:
        FileNotFoundError: no manifest, or a block is missing.
        ValueError: the collection is not complete, or a block is damaged: its checksum is not the manifest's.
        OSError: a file cannot be read.
    """

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        remedy = (
            f"collect the rollouts first: python -m stad_lab train ... --rollouts {self.folder}"
        )
        self.manifest = load_json(self.folder / MANIFEST, remedy)
        found, wanted = count_episodes(self.manifest)
        if found != wanted:
            raise ValueError(f"{self.folder} holds {found} of {wanted} episodes: {remedy}")
        blocks = self.manifest["blocks"]
        self.identity = identity_of(self.manifest)
        for entry in blocks:
            self._read(entry, "frames", (entry["frames"], FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
        self.frames = EpisodeFrames(
            [block_path(self.folder, entry["index"], "frames") for entry in blocks]
        )
        self.actions = [
            self._read(entry, "actions", (entry["frames"], 3), np.float32) for entry in blocks
        ]
        lengths = [entry["frames"] for entry in blocks]
        self.episode = np.repeat(np.arange(len(lengths)), lengths)  # of every frame in the dataset
        self.moment = np.concatenate(
            [np.arange(length) for length in lengths]
        )  # its index in that episode

    def _read(self, entry: dict, name: str, shape: tuple[int, ...], dtype) -> np.ndarray:
        path = block_path(self.folder, entry["index"], name)
        remedy = f"delete {self.folder} and collect again"
        if not path.exists():
            raise FileNotFoundError(f"{path} is missing although the manifest lists it: {remedy}")
        content = read_bytes(path, remedy)
        if checksum(content) != entry[f"{name}_sha256"]:
            raise ValueError(
                f"{path} is damaged ({len(content)} bytes, not the checksum in the manifest): {remedy}"
            )
        array = np.load(io.BytesIO(content), allow_pickle=False)
        if array.shape != shape or array.dtype != dtype:
            raise ValueError(
                f"{path} holds {array.dtype} {array.shape}, the manifest says {shape}: {remedy}"
            )
        return array

    def __len__(self) -> int:
        return len(self.episode)

    def pairs(self, indices: np.ndarray, stride: int) -> tuple[np.ndarray, np.ndarray]:
        """Frames and the frames to subtract from them, for indices into the whole dataset: two uint8 (n, 64, 64, 3)."""
        episodes, moments = self.episode[indices], self.moment[indices]
        before = earlier_index(moments, stride)
        frames, earlier = np.empty((2, len(indices), FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
        for place, episode in enumerate(episodes):
            self.frames.read(
                episode, [moments[place], before[place]], [frames[place], earlier[place]]
            )
        return frames, earlier

    def split(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of training and of held-out frames: the last twentieth of the episodes, at least one, is held out."""
        first = len(self.frames) - max(1, round(len(self.frames) / 20))
        return np.flatnonzero(self.episode < first), np.flatnonzero(self.episode >= first)
