"""Damaged files, killed processes, full disks: nothing is lost, and nothing damaged is used."""

import contextlib
import copy
import errno
import functools
import os
import random
import re
import shutil
import stat
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from torch.optim.optimizer import register_optimizer_step_post_hook

from stad_lab.agent import load_agent
from stad_lab.cli import main
from stad_lab.config import Config
from stad_lab.evaluation.evaluate import evaluate
from stad_lab.evaluation.statistics import summarise
from stad_lab.evaluation.verify import verify, verify_dataset
from stad_lab.io.files import load_json, load_tensors, save_json, save_tensors, write_bytes
from stad_lab.io.weights import MDN_RNN_FILE, VAE_FILE
from stad_lab.io.workers import TaskError
from stad_lab.training import dataset, evolution, pipeline, record
from stad_lab.training.dataset import MANIFEST, Dataset
from stad_lab.training.evolution import LOG, evolve
from stad_lab.training.mdn_rnn import train_mdn_rnn
from stad_lab.training.pipeline import STAGES, train
from stad_lab.training.record import open_record, provenance, read_finished
from stad_lab.training.vae import train_vae

QUICK = Config.preset("quick")
TRAININGS = {"vae": train_vae, "mdn_rnn": train_mdn_rnn}
CHECKPOINTS = tuple(f"{part}.training.safetensors" for part in TRAININGS)
WITHOUT_DATASET = shutil.ignore_patterns("dataset")


@pytest.fixture(scope="module")
def in_this_process():
    """An executor without processes: any one serves."""
    with ThreadPoolExecutor(1) as executor:
        yield executor


# Damaged files


@pytest.fixture(scope="module")
def whole(quick_run, tmp_path_factory, in_this_process):
    """A finished run with an evaluation, and with checkpoints of half-finished trainings."""
    folder = shutil.copytree(quick_run, tmp_path_factory.mktemp("faults") / "whole")
    result = evaluate(folder, 1, fast=True, executor=in_this_process)
    save_json(folder / "evaluation.json", result)
    add_checkpoints(folder, QUICK)
    return folder


@pytest.fixture(scope="module")
def another(tmp_path_factory, in_this_process):
    """A run of another seed, with checkpoints too."""
    folder = tmp_path_factory.mktemp("faults") / "another"
    brief = {"vae": {"steps": 12}, "mdn_rnn": {"steps": 12}}  # more than `add_checkpoints` makes
    config = QUICK.replace(seed=1, evolution={"generations": 2}, **brief)
    train(config, folder, executor=in_this_process)
    result = evaluate(folder, 1, fast=True, executor=in_this_process)
    save_json(folder / "evaluation.json", result)
    add_checkpoints(folder, config)
    return folder


def add_checkpoints(folder, config):
    """Interrupt a training of V and of M after ten steps; keep the checkpoint beside the result."""
    for part, again in TRAININGS.items():
        finished = folder / f"{part}.safetensors"
        content = finished.read_bytes()
        finished.unlink()
        left = [10]

        def interrupt(*_, left=left):
            left[0] -= 1
            if left[0] == 0:
                raise KeyboardInterrupt

        hook = register_optimizer_step_post_hook(interrupt)
        with pytest.raises(KeyboardInterrupt):
            again(config, lambda: Dataset(folder / "dataset"), folder)
        hook.remove()
        finished.write_bytes(content)


def resume_training(part):
    """Continue an interrupted training of V or M: what is read is the checkpoint."""

    def resume(folder):
        (folder / f"{part}.safetensors").unlink()
        TRAININGS[part](QUICK, lambda: Dataset(folder / "dataset"), folder)

    return resume


def read_dataset(folder):
    return Dataset(folder / "dataset")


def train_again(folder):
    return train(QUICK, folder)


def evolve_again(folder):
    return evolve(QUICK, folder)


READERS = {
    "dataset/manifest.json": [read_dataset],
    "dataset/00003.frames.npy": [read_dataset],
    "dataset/00005.actions.npy": [read_dataset],
    "vae.safetensors": [load_agent, evolve_again],
    "mdn_rnn.safetensors": [load_agent, train_again],
    "controller.safetensors": [load_agent, train_again],
    "evolution.json": [evolve_again],
    "record.json": [train_again],
    "evaluation.json": [lambda folder: load_json(folder / "evaluation.json")],
    "vae.training.safetensors": [resume_training("vae")],
    "mdn_rnn.training.safetensors": [resume_training("mdn_rnn")],
}
ROUNDS = 12  # of truncations and of flipped bits, for each file


def damages(content, rng):
    """Damaged versions of a file, each with a name; None stands for a folder in its place."""
    for _ in range(ROUNDS):
        length = rng.randrange(1, len(content))
        yield f"cut to {length} bytes", content[:length]
        # Half of the bits are near the beginning, where headers are.
        place = rng.randrange(min(len(content), 2000) if rng.random() < 0.5 else len(content))
        flipped = bytes([content[place] ^ (1 << rng.randrange(8))])
        yield f"bit of byte {place} flipped", content[:place] + flipped + content[place + 1 :]
    yield "emptied", b""
    yield "a folder in its place", None


def means_the_same(path, content):
    """Whether a changed file means the same: a flipped bit may make another kind of blank."""
    read = load_json if path.suffix == ".json" else load_tensors
    damaged = path.read_bytes()
    try:
        now = read(path)
        path.write_bytes(content)
        return str(now) == str(read(path))
    except ValueError:
        return False
    finally:
        path.write_bytes(damaged)


def put(path, content):
    """Put a content in a file's place; None stands for a folder."""
    if path.is_dir():
        path.rmdir()
    if content is None:
        path.unlink(missing_ok=True)
        path.mkdir()
    else:
        path.write_bytes(content)


def snapshot(folder):
    """The contents of all files of a run but the hidden ones."""
    paths = [path for path in folder.rglob("*") if not path.name.startswith(".")]
    return {path: path.read_bytes() if path.is_file() else None for path in paths}


def assert_refused(read, folder, what):
    """Reading ends in an error that names a file and a remedy, and changes nothing."""
    before = snapshot(folder)
    with pytest.raises((ValueError, OSError)) as caught:
        read(folder)
    message = str(caught.value)
    assert re.search(r"\.(json|npy|safetensors)", message) and str(folder) in message, (
        what,
        message,
    )
    remedy = r"delete|make it readable|give |choose|move it away|evolve C again|train|collect"
    assert re.search(remedy, message), (what, message)
    after = snapshot(folder)
    removed = {path.name for path in before if path not in after}
    assert removed <= {"vae.safetensors", "mdn_rnn.safetensors"}  # by resume_training itself
    assert all(after[path] == before[path] for path in after), what


def copy_for(name, run, folder):
    """A copy of a run, with checkpoints only if one is tested: beside weights they are deleted."""
    ignored = () if name in CHECKPOINTS else CHECKPOINTS
    return shutil.copytree(run, folder, ignore=shutil.ignore_patterns(*ignored))


def restore_weights(whole, folder):
    """Copy V and M back if a test has deleted them."""
    for part in TRAININGS:
        if not (folder / f"{part}.safetensors").exists():
            shutil.copy(whole / f"{part}.safetensors", folder)


def test_a_run_that_lost_its_v_or_half_its_dataset_is_mended_by_the_same_command(
    whole, tmp_path, in_this_process
):
    folder = shutil.copytree(whole, tmp_path / "run")
    before = {name: (folder / name).read_bytes() for name in (VAE_FILE, MDN_RNN_FILE, LOG)}
    (folder / VAE_FILE).unlink()
    assert train(QUICK, folder, executor=in_this_process)
    manifest = load_json(folder / "dataset" / MANIFEST)
    save_json(folder / "dataset" / MANIFEST, manifest | {"episodes": manifest["episodes"][:-1]})
    assert train(QUICK, folder, executor=in_this_process)
    assert {name: (folder / name).read_bytes() for name in before} == before


@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_refused_before_use_and_stays_as_it_is(name, whole, tmp_path):
    folder, refused = copy_for(name, whole, tmp_path / "run"), 0
    content, rng = (folder / name).read_bytes(), random.Random(name)
    for what, damaged in damages(content, rng):
        for read in READERS[name]:
            put(folder / name, damaged)
            if damaged and not name.endswith(".npy") and means_the_same(folder / name, content):
                continue
            assert_refused(read, folder, what)
            refused += 1
            restore_weights(whole, folder)
    assert refused >= 2 * ROUNDS - 4  # 11 files: more than 220 cases


@pytest.mark.parametrize("name", READERS)
def test_a_file_of_another_run_is_refused_before_use(
    name, whole, another, tmp_path, in_this_process
):
    folder = copy_for(name, whole, tmp_path / "run")
    shutil.copy(another / name, folder / name)
    if name == "evaluation.json":
        found = verify(folder, in_this_process)["evaluations"]
        assert found.startswith(f"FAILED: {folder / name} is of another controller")
        return
    for read in READERS[name]:
        assert_refused(read, folder, "of another run")
        restore_weights(whole, folder)


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read_is_an_error_that_says_so(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run", ignore=WITHOUT_DATASET)
    (folder / "mdn_rnn.safetensors").chmod(0)
    with pytest.raises(OSError, match=r"mdn_rnn.safetensors cannot be read .*: make it readable"):
        load_agent(folder)


# Runs of earlier versions


def test_a_run_of_the_first_edition_is_refused_and_left_as_it_is(whole, tmp_path, capsys):
    folder = tmp_path / "first"
    record = {"settings": {"episodes": 8}, "variant": "input_output", "seconds": {}}
    save_json(folder / "record.json", record)
    before = snapshot(folder)
    error = f"{folder / 'record.json'} is of 'input_output', no run: choose another folder"
    for again in (train_again, verify, read_finished):
        with pytest.raises(ValueError, match=re.escape(error)):
            again(folder)
    assert main(["train", "quick", "--variant", "input_output", "--out", str(folder)]) == 2
    assert f"error: {error}" in capsys.readouterr().err.splitlines()[-1]
    assert snapshot(folder) == before


def test_the_record_of_a_baseline_driver_is_no_run_to_continue_or_verify(tmp_path):
    record = {"kind": "record", "variant": "random_driver", "made_with": {}, "budget": {}}
    save_json(tmp_path / "record.json", record)
    for again in (train_again, verify, read_finished):
        with pytest.raises(ValueError, match=r"record.json is of 'random_driver', no run: choose"):
            again(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["record.json"]


@pytest.mark.parametrize("name", ["vae", "mdn_rnn", "controller"])
def test_weights_of_the_first_edition_are_refused_with_the_version_that_reads_them(
    name, whole, tmp_path
):
    folder = shutil.copytree(whole, tmp_path / "run", ignore=WITHOUT_DATASET)
    tensors, _ = load_tensors(folder / f"{name}.safetensors")
    save_tensors(folder / f"{name}.safetensors", tensors, part=name, settings={"width": 8})
    with pytest.raises(ValueError, match=rf"{name}.safetensors was written by stad_lab 0\.1: use"):
        load_agent(folder)


def test_a_run_made_before_a_setting_existed_continues_and_its_value_was_the_default(
    whole, tmp_path, in_this_process
):
    folder = shutil.copytree(whole, tmp_path / "run", ignore=WITHOUT_DATASET)
    log, record = load_json(folder / "evolution.json"), load_json(folder / "record.json")
    for settings in (log["evolution"], record["config"]["evolution"]):
        del settings["replay_share"], settings["step_size_rule"]
    del record["config"]["vae"]["difference_weight"]
    save_json(folder / "evolution.json", log)
    save_json(folder / "record.json", record)
    with pytest.raises(ValueError, match=r"made with evolution.replay_share=0.0, now evolution.re"):
        evolve(QUICK.replace(evolution={"replay_share": 0.5}), folder, in_this_process)
    longer = QUICK.replace(evolution={"generations": 6})
    assert evolve(longer, folder, in_this_process)
    assert verify(folder, in_this_process)["log of CMA-ES"].startswith("ok: 6 generations")
    assert load_json(folder / "evolution.json")["generations"][:4] == log["generations"]


# Killed processes


def stage_arguments(folder, stage):
    """The arguments that run everything up to a stage."""
    variant = ["train", "quick", "--variant", "input_output"]
    return [*variant, "--out", str(folder), "--until", stage]


def start_of(stage, run, folder):
    """A copy of a finished run in which the stage has not begun."""
    results = ["dataset", "vae.safetensors", "mdn_rnn.safetensors", "evolution.json"]
    later = [*results[STAGES.index(stage) :], "controller.safetensors", "*.training.*"]
    return shutil.copytree(run, folder, ignore=shutil.ignore_patterns(*later))


def kill_at_random(stage, run, tmp_path, kills):
    """Kill a stage at random moments until it was killed `kills` times; then let it end."""
    rng, killed, folder = random.Random(stage), 0, start_of(stage, run, tmp_path / "run0")
    duration = load_json(run / "record.json")["seconds"][stage]
    command = [sys.executable, "-m", "stad_lab"]
    quiet = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    while killed < kills:
        process = subprocess.Popen([*command, *stage_arguments(folder, stage)], **quiet)
        for _ in range(STAGES.index(stage)):  # every stage before it has nothing to do
            assert process.stdout.readline().rstrip().endswith(b"nothing to do")
        begin = time.perf_counter()
        try:
            process.wait(rng.uniform(0, duration if kills > 1 else duration / 2))
            duration = time.perf_counter() - begin  # it has ended, so it is quicker now
            folder = start_of(stage, run, tmp_path / f"run{killed}-{rng.random()}")
        except subprocess.TimeoutExpired:
            process.kill()
            killed += 1
        process.wait()
    assert main(stage_arguments(folder, stage)) == 0
    return folder


def assert_equal_results(folder, run, stage):
    """Everything up to the stage is bit-identical, and no half-written file is left."""
    results = ["dataset", "vae.safetensors", "mdn_rnn.safetensors", "evolution.json"]
    for name in results[: STAGES.index(stage) + 1]:
        files = sorted((run / name).glob("*.*")) if name == "dataset" else [run / name]
        for file in files:
            found = folder / file.relative_to(run)
            if not file.name.startswith("."):
                assert found.read_bytes() == file.read_bytes(), found
    if stage == "controller":
        name = "controller.safetensors"
        assert (folder / name).read_bytes() == (run / name).read_bytes()
    assert not list(folder.rglob("*.part"))


def test_a_killed_training_continues_to_the_same_bits(quick_run, tmp_path):
    assert_equal_results(kill_at_random("vae", quick_run, tmp_path, 1), quick_run, "vae")


@pytest.mark.long
@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_killed_at_twenty_random_moments_ends_with_the_same_bits(
    stage, quick_run, tmp_path
):
    assert_equal_results(kill_at_random(stage, quick_run, tmp_path, 20), quick_run, stage)


def test_half_written_files_of_a_killed_process_are_removed_and_those_of_others_stay(
    quick_run, tmp_path, in_this_process, monkeypatch
):
    folder, names = start_of("controller", quick_run, tmp_path / "run"), []
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    with monkeypatch.context() as patch:
        patch.setattr("stad_lab.io.files.replace", lambda part, _: names.append(part.name))
        for process in (ended.pid, 1, os.getppid()):  # in a container every run is process 1
            patch.setattr("os.getpid", lambda process=process: process)
            write_bytes(folder / LOG, b"{")
    left_over, another_run, alive = (folder / name for name in names)
    others = [folder / ".thesis.zip.part", alive]
    for file in (left_over, another_run, *others):
        file.write_bytes(b"{")
    os.utime(another_run, (0, 0))
    evolve(QUICK, folder, in_this_process)
    assert not left_over.exists() and not another_run.exists()
    assert all(file.exists() for file in others)


def test_a_key_that_is_there_twice_is_a_damage(tmp_path):
    file = tmp_path / "file.json"
    save_json(file, {"mean": 900})
    file.write_text(file.read_text().replace('"mean"', '"mean": 900, "mean"', 1))
    with pytest.raises(ValueError, match="'mean' is there twice"):
        load_json(file)


@pytest.mark.skipif(os.name == "nt", reason="a shell with sh's redirections")
@pytest.mark.parametrize("redirection", [">&- 2>&-", "2>&1 | head -1"])
def test_a_training_outlives_the_readers_of_its_output(redirection, quick_run, tmp_path):
    folder = start_of("controller", quick_run, tmp_path / "run")
    arguments = f"train quick --variant input_output --out {folder}"
    command = f"{sys.executable} -m stad_lab {arguments} {redirection}"
    subprocess.run(command, shell=True, timeout=120, capture_output="head" in redirection)
    assert_equal_results(folder, quick_run, "controller")


@pytest.mark.skipif(os.name == "nt", reason="Windows lets not every user make links")
def test_a_file_is_never_written_through_a_link(tmp_path, monkeypatch):
    """Neither one in its place nor one in the place of its temporary name."""
    (tmp_path / "secret").write_text("kept")
    (tmp_path / "file.json").symlink_to(tmp_path / "secret")
    save_json(tmp_path / "file.json", {})
    assert not (tmp_path / "file.json").is_symlink()
    monkeypatch.setattr("secrets.token_hex", lambda count: "0")
    (tmp_path / f".{os.getpid()}.0.part").symlink_to(tmp_path / "secret")
    with pytest.raises(OSError, match="could not be written"):
        save_json(tmp_path / "file.json", {})
    assert (tmp_path / "secret").read_text() == "kept"


def test_an_environment_that_raises_stops_the_run_with_its_cause_and_the_run_continues_later(
    quick_run, tmp_path, monkeypatch, in_this_process
):
    folder, drive, calls = start_of("controller", quick_run, tmp_path / "run"), evolution.drive, []

    def fragile(*arguments, **named):
        calls.append(1)
        if len(calls) == 6:
            raise RuntimeError("the track has fallen apart")
        return drive(*arguments, **named)

    monkeypatch.setattr(evolution, "drive", fragile)
    error = "drive_group failed in a worker: RuntimeError: the track has fallen apart"
    with pytest.raises(TaskError, match=error):
        evolve(QUICK, folder, in_this_process)
    done = len(load_json(folder / "evolution.json")["generations"])
    assert 1 <= done < QUICK.evolution.generations
    evolve(QUICK, folder, in_this_process)
    assert_equal_results(folder, quick_run, "controller")


# Folders and disks


def test_two_processes_do_not_share_the_folder_of_a_run(quick_run, tmp_path, capsys):
    folder = start_of("mdn_rnn", quick_run, tmp_path / "run")
    holder = """
import sys, time
from filelock import FileLock
with FileLock(sys.argv[1] + '/.lock'):
    print('held', flush=True)
    time.sleep(1000)
"""
    process = subprocess.Popen([sys.executable, "-c", holder, folder], stdout=subprocess.PIPE)
    assert process.stdout.readline().strip() == b"held"
    before = snapshot(folder)
    assert main(stage_arguments(folder, "mdn_rnn")) == 2
    error = f"error: {folder} is in use by another process: wait for it, or choose another folder"
    assert error in capsys.readouterr().err
    assert snapshot(folder) == before
    process.kill()  # and the lock is free at once
    process.wait()
    assert main(stage_arguments(folder, "mdn_rnn")) == 0


@pytest.fixture
def small_disk(tmp_path):
    """small_disk(megabytes) mounts or resizes a disk of that size and returns its folder."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = []

    def mount(megabytes, mode="rw"):
        options = f"{'remount,' if mounted else ''}size={megabytes}m,{mode}"
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder]
        if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
            pytest.skip("no right to mount a small disk")
        mounted.append(folder)
        return folder

    yield mount
    if mounted:
        subprocess.run(["umount", folder], check=True)


def test_a_full_disk_stops_the_run_in_one_line_and_with_more_space_it_continues(
    small_disk, quick_run, capsys
):
    disk = small_disk(8)
    run = start_of("vae", quick_run, disk / "run")
    (disk / "ballast").write_bytes(bytes(max(0, shutil.disk_usage(disk).free - 500_000)))
    assert main(stage_arguments(run, "vae")) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert re.match(
        r"error: .*could not be written \(No space left on device\): check the f", error
    )
    assert not (run / "vae.safetensors").exists()
    small_disk(64)
    assert main(stage_arguments(run, "vae")) == 0
    assert_equal_results(run, quick_run, "vae")


def test_a_read_only_folder_is_refused_before_any_work(small_disk, quick_run, capsys):
    disk = small_disk(64)
    run = start_of("mdn_rnn", quick_run, disk / "run")
    small_disk(64, "ro")
    assert main(stage_arguments(run, "mdn_rnn")) == 2
    error = f"error: cannot write to folder {run} (Read-only file system): choose"
    assert error in capsys.readouterr().err
    begin = time.perf_counter()
    result = str(disk / "evaluation.json")
    assert main(["evaluate", "--agent", str(quick_run), "--json", result]) == 2
    assert "evaluation.json could not be written (Read-only file system)" in capsys.readouterr().err
    assert time.perf_counter() - begin < 10  # not after the episodes


@pytest.mark.parametrize(
    ("refusals", "patience", "found"), [(2, 1.0, b"new"), (10_000, 0.1, b"old")]
)
def test_a_file_that_a_virus_scanner_holds_for_a_moment_is_written_a_moment_later(
    refusals, patience, found, tmp_path, monkeypatch
):
    file, replace, left = tmp_path / "file", Path.replace, [None] * refusals
    write_bytes(file, b"old")

    def refuse(path, target):
        if left:
            left.pop()
            raise PermissionError(errno.EACCES, "Permission denied")
        return replace(path, target)

    monkeypatch.setattr("stad_lab.io.files.PATIENCE", patience)
    monkeypatch.setattr(Path, "replace", refuse)
    refused = pytest.raises(OSError, match="could not be written")
    with contextlib.nullcontext() if found == b"new" else refused:
        write_bytes(file, b"new")
    assert file.read_bytes() == found and list(tmp_path.iterdir()) == [file]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limit")
def test_a_file_too_large_for_the_quota_leaves_the_old_one(tmp_path):
    import resource

    write_bytes(tmp_path / "file", b"old")
    allowed = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, allowed[1]))
    try:
        with pytest.raises(OSError, match=r"file could not be written \(File too large\)"):
            write_bytes(tmp_path / "file", bytes(2000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, allowed)
    assert (tmp_path / "file").read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.skipif(os.name == "nt", reason="Windows cannot open a folder, so none is flushed")
def test_files_can_be_written_to_a_share_that_cannot_flush_a_folder(tmp_path, monkeypatch):
    flush = os.fsync

    def flush_files_alone(opened):
        if stat.S_ISDIR(os.fstat(opened).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        flush(opened)

    monkeypatch.setattr("os.fsync", flush_files_alone)
    write_bytes(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_bytes() == b"new"


# Verify


def failures(found):
    """The checks of `verify` that failed."""
    return [name for name, outcome in found.items() if outcome.startswith("FAILED")]


def test_verify_drives_recorded_episodes_again(quick_run, capsys):
    assert main(["verify", "--run", str(quick_run)]) == 0
    printed = capsys.readouterr().out.replace("log of CMA-ES", "log")
    found = dict(line.split(maxsplit=1) for line in printed.splitlines())
    assert found["dataset"] == "ok: 8 episodes, 480 frames"
    assert found["log"] == "ok: 4 generations give the same mean"
    assert re.fullmatch(r"ok: .* points, bit-identical", found["episodes"])
    assert not failures(found)


def test_verify_says_how_far_an_interrupted_collection_is(quick_run, tmp_path):
    folder = shutil.copytree(quick_run / "dataset", tmp_path / "dataset")
    manifest = load_json(folder / "manifest.json")
    save_json(folder / "manifest.json", manifest | {"episodes": manifest["episodes"][:3]})
    assert verify_dataset(folder) == "none: 3 of 8 episodes so far"
    (folder / "manifest.json").unlink()
    assert verify_dataset(folder).startswith("none: ")


def test_verify_finds_a_return_that_no_episode_gives(quick_run, tmp_path, in_this_process, capsys):
    folder = shutil.copytree(quick_run, tmp_path / "run", ignore=WITHOUT_DATASET)
    log = load_json(folder / "evolution.json")
    log["generations"][log["best"]["generation"] - 1]["validation"]["returns"][0] += 0.001
    save_json(folder / "evolution.json", log)
    assert main(["verify", "--run", str(folder)]) == 1
    message = r"episodes +FAILED: the record says \[.*\], now it was \["
    assert re.search(message, capsys.readouterr().out)
    record = load_json(folder / "record.json")
    elsewhere = record["made_with"] | {"processor": "another processor"}
    save_json(folder / "record.json", record | {"continued_with": [elsewhere]})
    episodes = verify(folder, in_this_process)["episodes"]
    assert re.match(r"differs: .*; processor is '.*' and was 'another processor'", episodes)


@pytest.mark.parametrize(
    ("recorded", "points", "expected"),
    [
        ({}, 0.001, "FAILED"),
        ({"numba": None}, 0.001, "differs: .*; unknown, because not recorded: numba$"),
        ({"numba": None}, 60, "FAILED"),
        ({"processor": "another"}, 29, "differs: .*; processor is '.*' and was 'another'$"),
        ({"blas": "another"}, 29, "differs: .*; blas is '.*' and was 'another'$"),
        ({"blas": None}, 0.001, "FAILED"),
        ({"processor": "another"}, 60, "FAILED.*: rounding alone does not explain it"),
    ],
)
def test_verify_tolerates_a_bounded_difference_and_only_from_another_or_an_unknown_machine(
    recorded, points, expected, whole, tmp_path, in_this_process
):
    folder = shutil.copytree(whole, tmp_path / "run", ignore=WITHOUT_DATASET)
    result = load_json(folder / "evaluation.json")
    made_with = result["made_with"] | recorded
    known = {name: value for name, value in made_with.items() if value is not None}
    for episode in result["episodes"]:
        episode["return"] += points
    summary = summarise(np.array([episode["return"] for episode in result["episodes"]]))
    save_json(folder / "evaluation.json", result | summary | {"made_with": known})
    assert re.match(expected, verify(folder, in_this_process)["episodes"])


def test_verify_tolerates_rounding_in_a_replayed_log_and_nothing_more(
    quick_run, tmp_path, in_this_process
):
    folder = shutil.copytree(quick_run, tmp_path / "run", ignore=WITHOUT_DATASET)
    record, log = (load_json(folder / name) for name in ("record.json", "evolution.json"))
    elsewhere = record["made_with"] | {"processor": "another"}
    save_json(folder / "record.json", record | {"made_with": elsewhere})
    first = log["generations"][0]
    first["mean_checksum"] += 1  # as if its last bits had been others
    save_json(folder / "evolution.json", log)
    found = verify(folder, in_this_process)["log of CMA-ES"]
    assert found.startswith("differs: replaying the log gives another mean in generation 1")
    first["returns"] = first["returns"][::-1]
    save_json(folder / "evolution.json", log)
    found = verify(folder, in_this_process)["log of CMA-ES"]
    assert found.startswith("FAILED: replaying the log gives another mean in generation 1")


def test_verify_drives_the_episodes_of_an_evaluation_again(whole, tmp_path, in_this_process):
    folder = shutil.copytree(whole, tmp_path / "run", ignore=WITHOUT_DATASET)
    assert verify(folder, in_this_process)["episodes"].startswith("ok")
    result = load_json(folder / "evaluation.json")
    result["episodes"][0]["return"] += 0.001
    save_json(folder / "evaluation.json", result)
    assert set(failures(verify(folder, in_this_process))) == {"evaluations", "episodes"}


def test_verify_finds_a_controller_that_is_not_in_the_log(quick_run, tmp_path, in_this_process):
    folder = shutil.copytree(quick_run, tmp_path / "run")
    log = load_json(folder / "evolution.json")
    save_json(folder / "evolution.json", log | {"generations": log["generations"][:1]})
    found = verify(folder, in_this_process)
    assert found["dataset"].startswith("ok") and failures(found) == ["C", "episodes"]
    for part in failures(found):
        assert "does not come from the run in" in found[part]


@pytest.mark.parametrize(
    ("name", "part"), [("vae.safetensors", "V"), ("mdn_rnn.safetensors", "M"), ("dataset", "V")]
)
def test_verify_finds_a_part_of_another_run(name, part, whole, another, tmp_path, in_this_process):
    ignored = shutil.ignore_patterns(name, "evaluation.json")  # its episode is a long one
    folder = shutil.copytree(whole, tmp_path / "run", ignore=ignored)
    copy = shutil.copytree if name == "dataset" else shutil.copy
    copy(another / name, folder / name)
    assert part in failures(verify(folder, in_this_process))


def test_weights_without_a_log_or_an_evaluation_have_no_episodes_to_verify(
    quick_run, tmp_path, in_this_process
):
    ignored = shutil.ignore_patterns("evolution.json", "dataset")
    found = verify(shutil.copytree(quick_run, tmp_path / "run", ignore=ignored), in_this_process)
    nothing = {name for name, outcome in found.items() if outcome.startswith("none")}
    assert nothing >= {"log of CMA-ES", "C", "episodes"} and not failures(found)


def test_a_longer_run_that_was_killed_is_verified_and_is_not_finished(
    quick_run, tmp_path, in_this_process
):
    run = shutil.copytree(quick_run, tmp_path / "run", ignore=WITHOUT_DATASET)

    def kill(generations):
        if len(generations) == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evolve(QUICK.replace(evolution={"generations": 8}), run, in_this_process, watch=kill)
    found = verify(run, in_this_process)
    assert not failures(found)
    assert found["log of CMA-ES"] == "ok: 6 generations give the same mean"
    with pytest.raises(ValueError, match="is not finished, with 6 of 8 generations"):
        read_finished(run)


@pytest.mark.parametrize("lost", ["vae.safetensors", "mdn_rnn.safetensors"])
def test_a_run_that_has_lost_v_or_m_fails(lost, whole, tmp_path, in_this_process):
    ignored = shutil.ignore_patterns("dataset", lost)
    run = shutil.copytree(whole, tmp_path / "run", ignore=ignored)
    assert failures(verify(run, in_this_process))


# The record


def test_a_run_uses_no_network_and_writes_only_into_its_folder(quick_training):
    folder, process, _ = quick_training  # which the guard of conftest.py has watched
    assert "guarded" in process.stderr and "forbidden" not in process.stderr
    weights = {"vae.safetensors", "mdn_rnn.safetensors", "controller.safetensors"}
    others = {"dataset", "evolution.json", "record.json", ".lock"}
    assert {path.name for path in folder.iterdir()} == weights | others


def test_a_commit_and_its_changes_are_those_of_the_checkout_in_which_the_library_is(
    tmp_path, monkeypatch
):
    if record.git("rev-parse", "HEAD") is None:
        pytest.skip("this is no checkout that git reads")
    subprocess.run(["git", "init", "-q", tmp_path], check=True)
    who = ["-c", "user.name=somebody", "-c", "user.email=somebody@example.org"]
    commit = ["commit", "-q", "--allow-empty", "-m", "Begin a thesis"]
    subprocess.run(["git", "-C", tmp_path, *who, *commit], check=True)
    for name in ("training/record.py", "envs/physics.py"):
        (tmp_path / name).parent.mkdir()
        shutil.copy(Path(record.__file__).parents[1] / name, tmp_path / name)
    monkeypatch.setattr("stad_lab.training.record.__file__", str(tmp_path / name))
    found = provenance("there")
    assert found["commit"] is None and found["uncommitted_changes"] is None
    subprocess.run(["git", "-C", tmp_path, "add", "."], check=True)  # now the library is part of it
    subprocess.run(["git", "-C", tmp_path, *who, *commit], check=True)
    assert provenance("there")["uncommitted_changes"] is False
    (tmp_path / name).write_text("changed")
    assert provenance("there")["uncommitted_changes"] is True


def test_a_run_that_is_made_longer_has_the_new_configuration_in_its_record(quick_run):
    longer = QUICK.replace(evolution={"generations": 8})
    assert open_record(longer, quick_run, None, {})["config"] == longer.as_dict()


def run_stage(stage, folder, executor):
    return pipeline.run_stages({"mdn_rnn": stage}, QUICK, folder, None, executor, None)


def test_a_start_elsewhere_is_a_continuation_only_if_it_did_work(tmp_path, in_this_process):
    file = tmp_path / "record.json"
    run_stage(lambda _: True, tmp_path, in_this_process)
    whole = load_json(file)
    first = whole["made_with"] | {"commit": "an earlier one"}
    save_json(file, whole | {"made_with": first})
    run_stage(lambda _: False, tmp_path, in_this_process)
    assert load_json(file) == whole | {"made_with": first}
    for _ in range(2):
        run_stage(lambda _: True, tmp_path, in_this_process)
        found = load_json(file)
        assert (found["made_with"], found["continued_with"]) == (first, [whole["made_with"]])


def test_the_seconds_of_a_stage_are_those_of_all_its_starts(tmp_path, in_this_process):
    def stage(pool):
        time.sleep(0.1)
        if not (tmp_path / "record.json").exists():
            raise KeyboardInterrupt
        return True

    with pytest.raises(KeyboardInterrupt):
        run_stage(stage, tmp_path, in_this_process)
    first = load_json(tmp_path / "record.json")["seconds"]["mdn_rnn"]
    run_stage(stage, tmp_path, in_this_process)
    assert load_json(tmp_path / "record.json")["seconds"]["mdn_rnn"] >= first + 0.1 >= 0.2


def test_the_seconds_of_a_stage_survive_a_kill(tmp_path, in_this_process, monkeypatch):
    monkeypatch.setattr(record, "HEARTBEAT", 0.05)
    killed = []

    def stage(pool):
        time.sleep(0.5)
        killed.append((tmp_path / "record.json").read_bytes())  # what a kill would leave here
        return True

    run_stage(stage, tmp_path, in_this_process)
    whole = load_json(tmp_path / "record.json")["seconds"]["mdn_rnn"]
    (tmp_path / "record.json").write_bytes(killed[0])
    left = load_json(tmp_path / "record.json")["seconds"]["mdn_rnn"]
    assert 0.2 < left < whole
    run_stage(stage, tmp_path, in_this_process)
    assert load_json(tmp_path / "record.json")["seconds"]["mdn_rnn"] > left + 0.5


def test_a_full_training_reads_and_hashes_each_file_of_the_dataset_once(
    quick_run, tmp_path, monkeypatch, in_this_process
):
    run = start_of("vae", quick_run, tmp_path / "run")
    read, counted = dataset.read_bytes, Counter()

    def counting(path, remedy):
        counted[path.name] += 1
        return read(path, remedy)

    monkeypatch.setattr(dataset, "read_bytes", counting)
    config = QUICK.replace(vae={"steps": 2}, mdn_rnn={"steps": 2}, evolution={"components": 5})
    assert train(config, run, executor=in_this_process)
    files = {path.name for path in (run / "dataset").glob("*.npy")}
    assert set(counted) == files and set(counted.values()) == {1}


# Files with a right checksum and a wrong content


def places(value, place=()):
    """Every place in a nested value, of a list the first element."""
    if place:
        yield place
    pairs = value.items() if isinstance(value, dict) else enumerate(value[:1])
    for key, part in pairs if isinstance(value, dict | list) else ():
        yield from places(part, (*place, key)) if isinstance(part, dict | list) else [(*place, key)]


def changed(value, place, new):
    """A copy of a nested value with another part, or without it if `new` is None."""
    whole = copy.deepcopy(value)
    part = functools.reduce(lambda one, key: one[key], place[:-1], whole)
    if new is None:
        del part[place[-1]]
    else:
        part[place[-1]] = new
    return whole


@pytest.mark.parametrize("name", ["record.json", "evolution.json", "dataset/manifest.json"])
def test_a_file_with_a_right_checksum_and_a_wrong_content_is_refused_in_one_line(
    name, quick_run, tmp_path, in_this_process
):
    run = shutil.copytree(quick_run, tmp_path / "run")
    value, rng, refused = load_json(run / name), random.Random(name), 0
    for place in rng.sample(list(places(value)), 8):
        save_json(run / name, changed(value, place, rng.choice([None, "x", [], {}, -1])))
        found = "; ".join(failures_of(lambda: verify(run, in_this_process)))
        assert not re.search("object|subscript|FAILED: '|expected str", found), (place, found)
        refused += bool(found)
    assert refused >= 2


def failures_of(check):
    """What a check of a run refuses: the ValueError's message, or what it says FAILED."""
    try:
        return [text for text in check().values() if text.startswith("FAILED")]
    except ValueError as error:
        return [str(error)]


@pytest.mark.parametrize(
    ("kind", "place", "new", "fault"),
    [
        ("evaluation", ("episodes", 0, "return"), "x", "episodes[0].return is not of type float"),
        ("evaluation", ("episodes", 0, "track"), None, "it lacks episodes[0].track"),
        ("evolution", ("best",), 3, "best is not of type dict"),
        ("record", ("made_with",), [], "made_with is not of type dict"),
    ],
)
def test_what_a_file_lacks_is_named(kind, place, new, fault, whole, tmp_path):
    names = {"evaluation": "evaluation.json", "evolution": "evolution.json"}
    value = load_json(whole / names.get(kind, "record.json"))
    save_json(tmp_path / "file.json", changed(value, place, new))
    with pytest.raises(ValueError, match="is not a file of the kind") as caught:
        load_json(tmp_path / "file.json", "make it again")
    assert str(caught.value).endswith(f"{kind!r}: {fault}; make it again")
