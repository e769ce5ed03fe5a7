"""The random driver's dataset: complete, checked, of any size, and the same after any interrupt."""

import hashlib
import itertools
import json
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from stad_lab.__main__ import main
from stad_lab.config import Settings
from stad_lab.envs.car_racing import make_env
from stad_lab.envs.frames import difference_image, episode_differences, to_frame
from stad_lab.io.files import checksum, locked, save_json
from stad_lab.training.dataset import (
    TRACK_RANGES,
    RandomDriver,
    Rollouts,
    block_path,
    collect_rollouts,
    drive_randomly,
    track_seeds,
)

MANY = {
    "episodes": 40,
    "episode_frames": 30,
}  # a second of driving at least, so an interrupt comes in the middle


@pytest.fixture(scope="module")
def one_go(tmp_path_factory):
    """Many short episodes, collected by one process without interruption."""
    folder = tmp_path_factory.mktemp("rollouts") / "one_go"
    assert collect_rollouts(Settings.preset("quick", **MANY, processes=1), folder)
    return folder


@pytest.fixture
def copied(quick_run, tmp_path):
    """A dataset that a test may damage."""
    return shutil.copytree(quick_run / "rollouts", tmp_path / "rollouts")


def contents(folder):
    """The bytes of every file in a folder by its name; a killed process may leave hidden half-written files."""
    return {
        path.name: path.read_bytes() for path in folder.iterdir() if not path.name.startswith(".")
    }


def collect_command(folder):
    """The command that collects the same episodes as `one_go`, with two processes."""
    command = [
        sys.executable,
        "-m",
        "stad_lab",
        "train",
        "--variant",
        "frame",
        "--settings",
        "quick",
    ]
    command += ["--until", "rollouts", "--out", str(folder)]
    for name, value in MANY.items():
        command += ["--set", f"{name}={value}"]
    return command


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals to send to a process")
@pytest.mark.parametrize("how", ["SIGKILL", "SIGINT"])
def test_an_interrupted_collection_continues_and_equals_an_uninterrupted_one(how, one_go, tmp_path):
    manifest = tmp_path / "run" / "rollouts" / "manifest.json"
    process = subprocess.Popen(collect_command(tmp_path / "run"), stderr=subprocess.PIPE, text=True)
    deadline = time.time() + 120
    while (
        not manifest.exists() or len(json.loads(manifest.read_text(encoding="utf-8"))["blocks"]) < 3
    ):
        assert time.time() < deadline
        time.sleep(0.005)
    process.send_signal(getattr(signal, how))
    error = process.communicate(timeout=60)[1]
    if how == "SIGINT":
        assert process.returncode == 130, error
        assert "the same command goes on" in error
        assert "Traceback" not in error
    done = json.loads(manifest.read_text(encoding="utf-8"))["blocks"]
    assert 3 <= len(done) < MANY["episodes"]  # it was in the middle
    before = {path.name: path.stat().st_mtime_ns for path in manifest.parent.iterdir()}
    assert main(collect_command(tmp_path / "run")[3:]) == 0
    for entry in done:  # not collected again
        for name in (f"{entry['index']:05d}.frames.npy", f"{entry['index']:05d}.actions.npy"):
            assert (manifest.parent / name).stat().st_mtime_ns == before[name]
    assert contents(manifest.parent) == contents(one_go)
    assert len(json.loads(manifest.read_text(encoding="utf-8"))["blocks"]) == MANY["episodes"]


def test_a_complete_collection_is_left_alone(copied):
    before = contents(copied)
    assert not collect_rollouts(Settings.preset("quick"), copied)
    assert contents(copied) == before


def test_what_another_process_collected_a_moment_ago_is_not_driven_again(tmp_path, monkeypatch):
    settings, folder, lock = (
        Settings.preset("quick", episodes=3, episode_frames=30),
        tmp_path / "shared",
        locked,
    )
    written = {}

    def lock_late(place):
        monkeypatch.setattr("stad_lab.training.dataset.locked", lock)
        with ThreadPoolExecutor(1) as other:
            collect_rollouts(settings, folder, other)
        written.update({path: path.stat().st_mtime_ns for path in folder.glob("*.npy")})
        return lock(place)

    monkeypatch.setattr("stad_lab.training.dataset.locked", lock_late)
    with ThreadPoolExecutor(1) as executor:
        assert not collect_rollouts(settings, folder, executor)
    assert len(Rollouts(folder).frames) == 3
    assert written and {path: path.stat().st_mtime_ns for path in folder.glob("*.npy")} == written


def test_the_manifest_tells_settings_seeds_counts_and_checksums(quick_run):
    folder = quick_run / "rollouts"
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    settings = Settings.preset("quick")
    assert {name: getattr(settings, name) for name in manifest["settings"]} == manifest["settings"]
    assert [entry["index"] for entry in manifest["blocks"]] == list(range(settings.episodes))
    for entry in manifest["blocks"]:
        assert TRACK_RANGES["collect"][0] <= entry["track"] < TRACK_RANGES["collect"][1]
        for name in ("frames", "actions"):
            file = folder / f"{entry['index']:05d}.{name}.npy"
            assert len(np.load(file)) == entry["frames"]
            assert hashlib.sha256(file.read_bytes()).hexdigest() == entry[f"{name}_sha256"]


def test_a_block_can_be_driven_again(quick_run):
    rollouts = Rollouts(quick_run / "rollouts")
    frames, actions, track = drive_randomly(Settings.preset("quick"), 3)
    assert np.array_equal(frames, rollouts.frames[3])
    assert np.array_equal(actions, rollouts.actions[3])
    assert track == rollouts.manifest["blocks"][3]["track"]


@pytest.mark.parametrize("crop_bar", [True, False])
def test_an_action_stands_beside_the_frame_that_the_driver_saw(crop_bar):
    settings = Settings.preset("quick", random_starts=0.0, crop_bar=crop_bar)
    frames, actions, track = drive_randomly(settings, 1)
    env = make_env()
    observation, _ = env.reset(seed=track)
    for frame, action in zip(frames, actions, strict=True):
        assert np.array_equal(frame, to_frame(observation, crop_bar))
        observation, *_ = env.step(action)
    env.close()


def test_frames_are_uint8_and_actions_float32(quick_run):
    rollouts = Rollouts(quick_run / "rollouts")
    for frames, actions in zip(rollouts.frames, rollouts.actions, strict=True):
        assert frames.dtype == np.uint8
        assert frames.shape[1:] == (64, 64, 3)
        assert actions.dtype == np.float32
        assert actions.shape == (len(frames), 3)


READ_ALL = """
import sys
import numpy as np
from pathlib import Path
from stad_lab.io.workers import peak_memory
from stad_lab.training.dataset import Rollouts

before = peak_memory()["process"]
rollouts = Rollouts(Path(sys.argv[1]))
for indices in np.array_split(np.arange(len(rollouts)), 100):
    rollouts.pairs(indices, stride=4)
total = sum(frames.nbytes for frames in rollouts.frames)
print(total / 1e6, peak_memory()["process"] - before)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not tell a process's peak memory")
def test_reading_a_dataset_takes_little_memory_however_large_it_is(tmp_path):
    episodes, length = 50, 400
    blocks = []
    for index in range(episodes):
        entry = {"index": index, "track": index, "frames": length}
        for name, array in [
            ("frames", np.zeros((length, 64, 64, 3), np.uint8)),
            ("actions", np.zeros((length, 3))),
        ]:
            path = block_path(tmp_path, index, name)
            np.save(path, array.astype(np.uint8 if name == "frames" else np.float32))
            entry[f"{name}_sha256"] = checksum(path.read_bytes())
        blocks.append(entry)
    save_json(tmp_path / "manifest.json", {"settings": {"episodes": episodes}, "blocks": blocks})
    process = subprocess.run(
        [sys.executable, "-c", READ_ALL, tmp_path], capture_output=True, text=True, timeout=60
    )
    assert process.returncode == 0, process.stderr
    megabytes, grown = map(float, process.stdout.split())
    assert megabytes > 200
    assert grown < 40


def test_a_collection_says_its_size_on_the_disk_and_starts_only_if_there_is_room(
    quick_training, tmp_path, monkeypatch
):
    folder, process, _ = quick_training
    assert "rollouts: up to 0.01 GB in " in process.stdout
    size = sum(file.stat().st_size for file in (folder / "rollouts").glob("*.npy"))
    assert size == pytest.approx(8 * 60 * (64 * 64 * 3 + 12), rel=0.02)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: SimpleNamespace(free=122_000_000_000))
    with pytest.raises(
        OSError,
        match=r"up to 123\.00 GB in .* 122\.00 GB are free: free some room, choose a folder on another",
    ):
        collect_rollouts(
            Settings.preset("quick", episodes=10_000, episode_frames=1000), tmp_path / "huge"
        )
    assert [file.name for file in (tmp_path / "huge").iterdir()] == [".lock"]


def test_pairs_are_the_frames_of_the_difference_images(quick_run):
    rollouts = Rollouts(quick_run / "rollouts")
    assert len(rollouts) == sum(len(frames) for frames in rollouts.frames)
    frames, earlier = rollouts.pairs(np.arange(len(rollouts)), stride=4)
    expected = np.concatenate([episode_differences(frames, 4) for frames in rollouts.frames])
    assert np.array_equal(frames, np.concatenate(rollouts.frames))
    assert np.array_equal(difference_image(frames, earlier), expected)


def test_whole_episodes_are_held_out(quick_run):
    rollouts = Rollouts(quick_run / "rollouts")
    training, heldout = rollouts.split()
    assert sorted([*training, *heldout]) == list(range(len(rollouts)))
    assert len(training) > len(heldout) > 0
    assert not set(rollouts.episode[training]) & set(rollouts.episode[heldout])


def test_the_last_twentieth_of_the_episodes_is_held_out():
    episode = np.repeat(np.arange(40), 3)
    training, heldout = Rollouts.split(SimpleNamespace(frames=range(40), episode=episode))
    assert training.tolist() == list(range(38 * 3)) and heldout.tolist() == list(
        range(38 * 3, 40 * 3)
    )


def test_the_five_uses_share_no_track():
    ranges = sorted(TRACK_RANGES.values())
    assert all(before[1] <= after[0] for before, after in itertools.pairwise(ranges))
    for use, (low, high) in TRACK_RANGES.items():
        assert all(low <= track < high for track in track_seeds(use, 1000, 0))
    assert (
        track_seeds("evolve", 4, 0, 1)
        != track_seeds("evolve", 4, 0, 2)
        != track_seeds("evolve", 4, 1, 2)
    )


def test_the_random_driver_gives_smooth_actions_within_bounds():
    driver = RandomDriver(np.random.default_rng(0))
    actions = np.array([driver.act() for _ in range(5000)])
    assert actions.dtype == np.float32
    assert (actions >= [-1, 0, 0]).all()
    assert (actions <= 1).all()
    assert abs(actions[:, 0].mean()) < 0.1  # turns to both sides
    assert np.abs(np.diff(actions[:, 0])).mean() < 0.5 * actions[:, 0].std()
    assert 0 < (actions[:, 2] > 0).mean() < 0.3  # brakes, rarely
    assert not ((actions[:, 1] > 0) & (actions[:, 2] > 0)).any()


def test_most_episodes_start_on_their_way():
    moving = Settings.preset("quick", random_starts=1.0, episode_frames=25)
    at_rest = Settings.preset("quick", random_starts=0.0, episode_frames=25)
    for index in range(2):
        zoomed_out, close = (
            drive_randomly(at_rest, index)[0][0],
            drive_randomly(moving, index)[0][0],
        )
        assert (
            (zoomed_out == 0).mean() > 0.2 > (close == 0).mean()
        )  # the opening zoom shows the dark outside


@pytest.mark.parametrize("name", ["00002.frames.npy", "00005.actions.npy"])
def test_a_missing_block_is_an_error_that_names_it(name, copied):
    (copied / name).unlink()
    with pytest.raises(
        FileNotFoundError,
        match=f"{name} is missing although the manifest lists it: delete .* again",
    ):
        Rollouts(copied)


def test_a_block_cut_short_is_an_error_that_names_it(copied):
    block = copied / "00002.frames.npy"
    block.write_bytes(block.read_bytes()[:5000])
    with pytest.raises(
        ValueError,
        match=r"00002.frames.npy is damaged \(5000 bytes.*checksum.*delete .* collect again",
    ):
        Rollouts(copied)


def test_a_file_cut_short_after_it_was_found_whole_gives_no_pictures(copied):
    rollouts = Rollouts(copied)
    path = sorted(copied.glob("*.frames.npy"))[-1]
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(
        ValueError, match=r"frames\.npy is shorter than it was: collect in another folder"
    ):
        rollouts.pairs(np.array([len(rollouts) - 1]), 4)


def test_one_flipped_bit_is_an_error_that_names_the_block(copied):
    block = copied / "00004.frames.npy"
    content = bytearray(block.read_bytes())
    content[-1] ^= 1
    block.write_bytes(content)
    with pytest.raises(ValueError, match=r"00004.frames.npy is damaged.*delete .* collect again"):
        Rollouts(copied)


def test_a_damaged_manifest_is_an_error_that_names_it(copied):
    manifest = copied / "manifest.json"
    manifest.write_text(manifest.read_text(encoding="utf-8")[:100])
    with pytest.raises(ValueError, match=r"manifest.json is damaged.*delete it and collect"):
        Rollouts(copied)


def test_a_folder_without_rollouts_is_an_error_that_names_the_command(tmp_path):
    with pytest.raises(
        FileNotFoundError,
        match=r"manifest.json does not exist.*collect the rollouts first: python -m",
    ):
        Rollouts(tmp_path / "nowhere")


def test_rollouts_of_other_settings_are_refused(copied):
    before = contents(copied)
    with pytest.raises(
        ValueError,
        match=r"'episodes': 8.*'episodes': 9.*choose another folder or the same settings",
    ):
        collect_rollouts(Settings.preset("quick", episodes=9), copied)
    assert contents(copied) == before


def test_an_unfinished_collection_is_not_taken_for_a_dataset(copied):
    manifest = json.loads((copied / "manifest.json").read_text(encoding="utf-8"))
    save_json(copied / "manifest.json", manifest | {"blocks": []})
    with pytest.raises(ValueError, match=r"\b0\b.*\b8\b.*collect"):
        Rollouts(copied)
