"""The random driver's dataset: complete, checked, and the same after any interrupt."""

import hashlib
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from stad_lab.cli import main
from stad_lab.config import TRACK_RANGES, Config
from stad_lab.envs.cars import Cars
from stad_lab.envs.frames import difference_image, episode_differences
from stad_lab.envs.state import true_motion
from stad_lab.io.files import checksum, load_json, locked, save_json
from stad_lab.training.dataset import (
    MANIFEST,
    Dataset,
    RandomDriver,
    collect,
    drive_randomly,
    episode_file,
    random_start,
)

QUICK = Config.preset("quick")
# A second of driving at least, so that an interrupt comes in the middle.
MANY = {"episodes": 120, "episode_frames": 30}  # some seconds: time for an interrupt


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Many short episodes, collected by one process without interruption."""
    folder = tmp_path_factory.mktemp("dataset") / "uninterrupted"
    assert collect(QUICK.replace(data=MANY, processes=1), folder)
    return folder


@pytest.fixture
def copied(quick_run, tmp_path):
    """A dataset that a test may damage."""
    return shutil.copytree(quick_run / "dataset", tmp_path / "dataset")


def contents(folder):
    """The bytes of every file by its name, without the hidden ones that a kill may leave."""
    return {
        path.name: path.read_bytes() for path in folder.iterdir() if not path.name.startswith(".")
    }


def collect_command(folder):
    """The arguments that collect the same episodes as `uninterrupted`, with two processes."""
    changes = ["--data.episodes", "120", "--data.episode-frames", "30"]
    return ["train", "quick", "--until", "dataset", "--out", str(folder), *changes]


def stop_collecting(arguments, manifest, episodes, how):
    """Send a signal to a collection that has so many episodes: (the process, its errors)."""
    command = [sys.executable, "-m", "stad_lab", *arguments]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    deadline = time.time() + 120
    while not manifest.exists() or len(load_json(manifest)["episodes"]) < episodes:
        assert time.time() < deadline
        time.sleep(0.005)
    process.send_signal(how)
    return process, process.communicate(timeout=60)[1]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals to send to a process")
def test_a_collection_interrupted_and_killed_continues_and_equals_an_uninterrupted_one(
    uninterrupted, tmp_path
):
    manifest, arguments = tmp_path / "run" / "dataset" / MANIFEST, collect_command(tmp_path / "run")
    done = []
    for how in (signal.SIGINT, signal.SIGKILL):
        process, error = stop_collecting(arguments, manifest, len(done) + 3, how)
        if how == signal.SIGINT:
            assert process.returncode == 130, error
            assert "the same command continues" in error and "Traceback" not in error
        earlier, done = done, load_json(manifest)["episodes"]
        assert len(earlier) + 3 <= len(done) < MANY["episodes"]  # it was in the middle
    before = {path: path.stat().st_mtime_ns for path in manifest.parent.iterdir()}
    assert main(arguments) == 0
    for entry in done:  # not collected again
        for name in ("frames", "actions"):
            path = episode_file(manifest.parent, entry["index"], name)
            assert path.stat().st_mtime_ns == before[path]
    assert contents(manifest.parent) == contents(uninterrupted)


def test_a_complete_collection_is_left_alone(copied):
    before = contents(copied)
    assert not collect(QUICK, copied)
    assert contents(copied) == before


def test_what_another_process_collected_a_moment_ago_is_not_driven_again(tmp_path, monkeypatch):
    config, folder = QUICK.replace(data={"episodes": 3, "episode_frames": 30}), tmp_path / "shared"
    written = {}

    def lock_late(place):
        monkeypatch.setattr("stad_lab.training.dataset.locked", locked)
        with ThreadPoolExecutor(1) as other:
            collect(config, folder, other)
        written.update({path: path.stat().st_mtime_ns for path in folder.glob("*.npy")})
        return locked(place)

    monkeypatch.setattr("stad_lab.training.dataset.locked", lock_late)
    with ThreadPoolExecutor(1) as executor:
        assert not collect(config, folder, executor)
    assert len(Dataset(folder).frames) == 3
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*.npy")} == written != {}


def test_the_manifest_has_the_configuration_the_tracks_the_lengths_and_the_checksums(quick_run):
    folder = quick_run / "dataset"
    manifest = load_json(folder / MANIFEST)
    made_with, data = manifest["made_with"], QUICK.as_dict()["data"]
    assert made_with["seed"] == QUICK.seed
    assert made_with["data"] == {name: data[name] for name in made_with["data"]}
    assert [entry["index"] for entry in manifest["episodes"]] == list(range(QUICK.data.episodes))
    low, high = TRACK_RANGES["collect"]
    for entry in manifest["episodes"]:
        assert low <= entry["track"] < high
        for name in ("frames", "actions"):
            file = episode_file(folder, entry["index"], name)
            assert len(np.load(file)) == entry["frames"]
            assert hashlib.sha256(file.read_bytes()).hexdigest() == entry[f"{name}_sha256"]


def test_an_episode_can_be_driven_again_bit_for_bit(quick_run):
    dataset = Dataset(quick_run / "dataset")
    frames, actions, track = drive_randomly(QUICK, 3)
    assert np.array_equal(frames, dataset.frames[3])
    assert np.array_equal(actions, dataset.actions[3])
    assert track == dataset.manifest["episodes"][3]["track"]


@pytest.mark.parametrize("crop_bar", [True, False])
def test_an_action_is_kept_with_the_frame_on_which_it_was_taken(crop_bar):
    config = QUICK.replace(data={"random_starts": 0.0, "crop_bar": crop_bar})
    frames, actions, track = drive_randomly(config, 1)
    cars = Cars(1, "frame", bar=not crop_bar)
    cars.reset([track])
    for frame, action in zip(frames, actions, strict=True):
        assert np.array_equal(frame, cars.draw()[0])
        cars.step(action[None])


def test_frames_are_uint8_and_actions_float32(quick_run):
    dataset = Dataset(quick_run / "dataset")
    for frames, actions in zip(dataset.frames, dataset.actions, strict=True):
        assert frames.dtype == np.uint8 and frames.shape[1:] == (64, 64, 3)
        assert actions.dtype == np.float32 and actions.shape == (len(frames), 3)


READ_ALL = """
import sys
import numpy as np, psutil
from pathlib import Path
from stad_lab.training.dataset import Dataset

# Not ru_maxrss: on Linux it begins with the peak of the process that started this one.
used = lambda: psutil.Process().memory_info().rss / 1e6
before, grown = used(), 0.0
dataset = Dataset(Path(sys.argv[1]))
for indices in np.array_split(np.arange(len(dataset)), 100):
    dataset.pairs(indices, stride=4)
    grown = max(grown, used() - before)
print(sum(frames.nbytes for frames in dataset.frames) / 1e6, grown)
"""


def test_reading_a_dataset_takes_little_memory_however_large_it_is(tmp_path):
    length, episodes = 400, []
    arrays = {"frames": np.zeros((length, 64, 64, 3), np.uint8)}
    arrays["actions"] = np.zeros((length, 3), np.float32)
    for index in range(50):
        entry = {"index": index, "track": index, "frames": length}
        for name, array in arrays.items():
            path = episode_file(tmp_path, index, name)
            np.save(path, array)
            entry[f"{name}_sha256"] = checksum(path.read_bytes())
        episodes.append(entry)
    made_with = {"data": {"episodes": len(episodes)}}
    save_json(tmp_path / MANIFEST, {"made_with": made_with, "episodes": episodes})
    command = [sys.executable, "-c", READ_ALL, tmp_path]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert process.returncode == 0, process.stderr
    megabytes, grown = map(float, process.stdout.split())
    assert megabytes > 200 and grown < 40


def test_a_collection_prints_its_size_and_starts_only_if_the_disk_has_the_space(
    quick_training, tmp_path, monkeypatch
):
    folder, process, _ = quick_training
    assert "dataset: up to 0.01 GB in " in process.stdout
    size = sum(file.stat().st_size for file in (folder / "dataset").glob("*.npy"))
    assert size == pytest.approx(8 * 60 * (64 * 64 * 3 + 12), rel=0.02)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: SimpleNamespace(free=122_000_000_000))
    huge = QUICK.replace(data={"episodes": 10_000, "episode_frames": 1000})
    with pytest.raises(OSError, match=r"up to 123\.00 GB in .* 122\.00 GB are free: free some sp"):
        collect(huge, tmp_path / "huge")
    assert [file.name for file in (tmp_path / "huge").iterdir()] == [".lock"]


def test_pairs_are_the_frames_of_the_difference_images(quick_run):
    dataset = Dataset(quick_run / "dataset")
    frames, earlier = dataset.pairs(np.arange(len(dataset)), stride=4)
    expected = np.concatenate([episode_differences(frames, 4) for frames in dataset.frames])
    assert np.array_equal(frames, np.concatenate(list(dataset.frames)))
    assert np.array_equal(difference_image(frames, earlier), expected)


def test_whole_episodes_the_last_twentieth_are_held_out(quick_run):
    dataset = Dataset(quick_run / "dataset")
    training, heldout = dataset.split()
    assert sorted([*training, *heldout]) == list(range(len(dataset)))
    assert set(dataset.episode[heldout]) == {7} and 7 not in dataset.episode[training]
    for episodes, first in ((40, 38), (900, 855), (2, 1)):
        sized = SimpleNamespace(frames=range(episodes))
        assert Dataset.first_heldout.fget(sized) == first


def test_the_random_driver_gives_smooth_actions_within_bounds():
    driver = RandomDriver(np.random.default_rng(0))
    actions = np.array([driver.act() for _ in range(5000)])
    assert actions.dtype == np.float32
    assert (actions >= [-1, 0, 0]).all() and (actions <= 1).all()
    assert abs(actions[:, 0].mean()) < 0.1  # turns to both sides
    assert np.abs(np.diff(actions[:, 0])).mean() < 0.5 * actions[:, 0].std()
    assert 0 < (actions[:, 2] > 0).mean() < 0.3  # brakes, rarely
    assert not ((actions[:, 1] > 0) & (actions[:, 2] > 0)).any()


def test_random_starts_begin_on_the_road_and_not_in_the_opening_zoom():
    for index in range(2):
        dark = []  # share of black pixels in the first frame: the zoom shows what is outside
        for share in (0.0, 1.0):
            cars, _ = random_start(QUICK.replace(data={"random_starts": share}), index)
            dark.append((cars.draw()[0] == 0).mean())
            assert abs(true_motion(cars)[4]) < 1  # offset in half road widths
        assert dark[0] > 0.2 > dark[1]


def cut(path, length):
    path.write_bytes(path.read_bytes()[:length])


def flip_last_bit(path):
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "damage", "error"),
    [
        ("00002.frames.npy", lambda path: path.unlink(), "does not exist: delete .* collect again"),
        ("00005.actions.npy", lambda path: path.unlink(), "does not exist: delete .* collect agai"),
        ("00002.frames.npy", lambda path: cut(path, 5000), "is damaged.*delete .* collect again"),
        ("00004.frames.npy", flip_last_bit, "is damaged.*delete .* collect again"),
        (MANIFEST, lambda path: cut(path, 100), "is damaged.*delete it and collect"),
        (MANIFEST, lambda path: path.unlink(), "does not exist: collect it first: python -m stad_"),
    ],
)
def test_a_missing_or_damaged_file_is_an_error_that_names_it(name, damage, error, copied):
    damage(copied / name)
    with pytest.raises((ValueError, FileNotFoundError), match=f"{name} {error}"):
        Dataset(copied)


def test_a_file_cut_short_after_it_was_checked_gives_no_frames(copied):
    dataset = Dataset(copied)
    cut(sorted(copied.glob("*.frames.npy"))[-1], 2000)
    with pytest.raises(ValueError, match=r"frames\.npy was cut short: collect in a new folder"):
        dataset.pairs(np.array([len(dataset) - 1]), 4)


def test_a_dataset_of_another_configuration_is_refused_and_stays_as_it_was(copied):
    before = contents(copied)
    for config, was in (
        (QUICK.replace(data={"episodes": 9}), "data.episodes=8, now data.episodes=9"),
        (QUICK.replace(seed=1), "seed=0, now seed=1"),
        # Of a second iteration, whose dataset has the episodes of both drivers.
        (QUICK.replace(data={"agent_episodes": 3}), "data.agent_episodes=0, now data.agent_episod"),
    ):
        with pytest.raises(ValueError, match=f"{was}.*choose another folder"):
            collect(config, copied)
    assert contents(copied) == before


def test_an_unfinished_collection_is_not_taken_for_a_dataset(copied):
    manifest = load_json(copied / MANIFEST)
    save_json(copied / MANIFEST, manifest | {"episodes": []})
    with pytest.raises(ValueError, match=r"holds 0 of 8 episodes: collect"):
        Dataset(copied)
