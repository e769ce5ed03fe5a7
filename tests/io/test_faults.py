"""Broken files, broken machines and impatient people: nothing is lost, nothing is used that is not whole."""

import contextlib
import dataclasses
import errno
import os
import random
import re
import shutil
import stat
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest
from torch.optim.optimizer import register_optimizer_step_post_hook
from worker_tasks import always_die, die_once, hang_once

from stad_lab.__main__ import main
from stad_lab.agent import load_agent
from stad_lab.config import Settings
from stad_lab.evaluation.evaluate import evaluate
from stad_lab.evaluation.verify import verify, verify_rollouts
from stad_lab.io.files import checksum, load_json, load_tensors, save_json, write_bytes
from stad_lab.io.workers import TaskError, WorkerProcesses, run_tasks, worker_processes
from stad_lab.models.mdn_rnn import train_mdn_rnn
from stad_lab.models.vae import train_autoencoder
from stad_lab.replication.tables import RECORDS
from stad_lab.training import evolution, pipeline
from stad_lab.training.dataset import Rollouts
from stad_lab.training.evolution import evolve
from stad_lab.training.pipeline import STAGES, provenance, train

VARIANT, SETTINGS = "input_output", Settings.preset("quick")
CHECKPOINTS = ("autoencoder.training.safetensors", "mdn_rnn.training.safetensors")


@pytest.fixture(scope="module")
def in_this_process():
    """An executor without processes: any one serves."""
    with ThreadPoolExecutor(1) as executor:
        yield executor


# Broken files


@pytest.fixture(scope="module")
def whole(quick_run, tmp_path_factory, in_this_process):
    """A finished run with an evaluation, and the checkpoints of trainings that were interrupted half way."""
    folder = shutil.copytree(quick_run, tmp_path_factory.mktemp("faults") / "whole")
    save_json(
        folder / "evaluation.json",
        evaluate(VARIANT, folder, 1, fast=True, executor=in_this_process),
    )
    add_checkpoints(folder, SETTINGS)
    return folder


@pytest.fixture(scope="module")
def another(tmp_path_factory, whole, in_this_process):
    """A run of another seed, with checkpoints too."""
    folder, settings = (
        tmp_path_factory.mktemp("faults") / "another",
        Settings.preset("quick", seed=1, generations=2),
    )
    train(VARIANT, settings, folder, executor=in_this_process)
    own = {"controller_sha256": checksum((folder / "controller.safetensors").read_bytes())}
    save_json(folder / "evaluation.json", load_json(whole / "evaluation.json") | own)
    add_checkpoints(folder, settings)
    return folder


def add_checkpoints(folder, settings):
    """Interrupt a training of V and one of M after ten steps, and keep their checkpoints beside the finished run."""
    trainings = {"autoencoder": train_autoencoder, "mdn_rnn": train_mdn_rnn}
    for part, again in trainings.items():
        finished, content = (
            folder / f"{part}.safetensors",
            (folder / f"{part}.safetensors").read_bytes(),
        )
        finished.unlink()
        left = [10]

        def interrupt(*_, left=left):
            left[0] -= 1
            if left[0] == 0:
                raise KeyboardInterrupt

        hook = register_optimizer_step_post_hook(interrupt)
        with pytest.raises(KeyboardInterrupt):
            again(VARIANT, settings, folder / "rollouts", folder)
        hook.remove()
        finished.write_bytes(content)


def resume_training(part):
    """Go on with an interrupted training of V or M: what is read is the checkpoint."""

    def resume(folder):
        (folder / f"{part}.safetensors").unlink()
        {"autoencoder": train_autoencoder, "mdn_rnn": train_mdn_rnn}[part](
            VARIANT, SETTINGS, folder / "rollouts", folder
        )

    return resume


READERS = {
    "rollouts/manifest.json": [lambda folder: Rollouts(folder / "rollouts")],
    "rollouts/00003.frames.npy": [lambda folder: Rollouts(folder / "rollouts")],
    "rollouts/00005.actions.npy": [lambda folder: Rollouts(folder / "rollouts")],
    "autoencoder.safetensors": [
        lambda folder: load_agent(VARIANT, folder),
        lambda folder: evolve(VARIANT, SETTINGS, folder),
    ],
    "mdn_rnn.safetensors": [
        lambda folder: load_agent(VARIANT, folder),
        lambda folder: train(VARIANT, SETTINGS, folder),
    ],
    "controller.safetensors": [
        lambda folder: load_agent(VARIANT, folder),
        lambda folder: train(VARIANT, SETTINGS, folder),
    ],
    "evolution.json": [lambda folder: evolve(VARIANT, SETTINGS, folder)],
    "record.json": [lambda folder: train(VARIANT, SETTINGS, folder)],
    "evaluation.json": [lambda folder: load_json(folder / "evaluation.json")],
    "autoencoder.training.safetensors": [resume_training("autoencoder")],
    "mdn_rnn.training.safetensors": [resume_training("mdn_rnn")],
}
ROUNDS = 12  # of truncations and of flipped bits, for each file


def damages(content, rng):
    """Broken versions of a file's content, each with a name; None stands for a folder in the file's place."""
    for _ in range(ROUNDS):
        length = rng.randrange(1, len(content))
        yield f"cut to {length} bytes", content[:length]
        # Half of the bits near the beginning, where headers are: a flip in a million weights is the easy case.
        place = rng.randrange(min(len(content), 2000) if rng.random() < 0.5 else len(content))
        flipped = bytes([content[place] ^ (1 << rng.randrange(8))])
        yield f"bit of byte {place} flipped", content[:place] + flipped + content[place + 1 :]
    yield "emptied", b""
    yield "a folder in its place", None


def says_the_same(path, content):
    """Whether a changed file still says what it said: a flipped bit may turn one blank into another kind of blank."""
    damaged = path.read_bytes()
    try:
        now = load_json(path) if path.suffix == ".json" else load_tensors(path)
        path.write_bytes(content)
        was = load_json(path) if path.suffix == ".json" else load_tensors(path)
    except ValueError:
        return False
    finally:
        path.write_bytes(damaged)
    return str(now) == str(was)


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
    """All files of a run and what is in them, but for hidden ones."""
    paths = [path for path in folder.rglob("*") if not path.name.startswith(".")]
    return {path: path.read_bytes() if path.is_file() else None for path in paths}


def assert_refused(read, folder, name, what):
    """Reading ends in one clear error that names a file of the run and a remedy, and changes nothing."""
    before = snapshot(folder)
    with pytest.raises((ValueError, OSError)) as caught:
        read(folder)
    message = str(caught.value)
    assert re.search(r"\.(json|npy|safetensors)", message), (name, what, message)
    assert str(folder) in message, (name, what, message)
    remedy = r"delete|make it readable|give |choose|move it away|evolve C again|train|collect"
    assert re.search(remedy, message), (name, what, message)
    after = snapshot(folder)
    removed = {path for path in before if path not in after}
    assert removed <= {
        folder / "autoencoder.safetensors",
        folder / "mdn_rnn.safetensors",
    }  # by resume_training itself
    assert all(after[path] == before[path] for path in after), (name, what)


def copy_for(name, run, folder):
    """A copy of a run, without the checkpoints unless one of them is to be broken: beside weights they are deleted."""
    shutil.copytree(
        run, folder, ignore=shutil.ignore_patterns(*() if name in CHECKPOINTS else CHECKPOINTS)
    )
    return folder


@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_refused_before_use_and_stays_as_it_is(name, whole, tmp_path):
    folder, refused = copy_for(name, whole, tmp_path / "run"), 0
    content, rng = (folder / name).read_bytes(), random.Random(name)
    for what, damaged in damages(content, rng):
        for read in READERS[name]:
            put(folder / name, damaged)
            if damaged and not name.endswith(".npy") and says_the_same(folder / name, content):
                continue
            assert_refused(read, folder, name, what)
            refused += 1
            for part in ("autoencoder.safetensors", "mdn_rnn.safetensors"):
                if not (folder / part).exists():
                    shutil.copy(whole / part, folder / part)
    assert refused >= 2 * ROUNDS - 4  # 11 files: more than 220 cases


@pytest.mark.parametrize("name", READERS)
def test_a_file_of_another_run_is_refused_before_use(
    name, whole, another, tmp_path, in_this_process
):
    folder = copy_for(name, whole, tmp_path / "run")
    shutil.copy(another / name, folder / name)
    if name == "evaluation.json":
        assert verify(folder, in_this_process)["evaluations"].startswith(
            f"FAILED: {folder / name} tells of another"
        )
        return
    for read in READERS[name]:
        assert_refused(read, folder, name, "of another run")
        for part in ("autoencoder.safetensors", "mdn_rnn.safetensors"):
            if not (folder / part).exists():
                shutil.copy(whole / part, folder / part)


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read_is_an_error_that_says_so(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    (folder / "mdn_rnn.safetensors").chmod(0)
    with pytest.raises(OSError, match=r"mdn_rnn.safetensors cannot be read .*: make it readable"):
        load_agent(VARIANT, folder)


# Killed processes


def stage_command(folder, stage):
    """The command that runs everything up to a stage."""
    command = [
        sys.executable,
        "-m",
        "stad_lab",
        "train",
        "--variant",
        VARIANT,
        "--settings",
        "quick",
    ]
    return [*command, "--out", str(folder), "--until", stage]


def start_of(stage, run, folder):
    """A copy of a finished run in which the stage has not begun."""
    results = (
        "rollouts",
        "autoencoder.safetensors",
        "mdn_rnn.safetensors",
        "evolution.json",
        "controller.safetensors",
    )
    return shutil.copytree(
        run, folder, ignore=shutil.ignore_patterns(*results[STAGES.index(stage) :], "*.training.*")
    )


def kill_at_random(stage, run, tmp_path, kills):
    """Kill a stage at random moments, again and again, until it has been killed `kills` times; then let it end."""
    rng, killed, folder = random.Random(stage), 0, start_of(stage, run, tmp_path / "run0")
    duration = load_json(run / "record.json")["seconds"][stage]
    while killed < kills:
        process = subprocess.Popen(
            stage_command(folder, stage), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        before = STAGES.index(stage)
        while before:  # every stage before it says that there is nothing to do
            line = process.stdout.readline()
            assert line, "the command ended before its stage began"
            before -= line.rstrip().endswith(b"nothing to do")
        begin = time.perf_counter()
        try:
            process.wait(rng.uniform(0, duration))
            duration = (
                time.perf_counter() - begin
            )  # it was done already, so it is quicker now: from the start
            folder = start_of(stage, run, tmp_path / f"run{killed}-{rng.random()}")
        except subprocess.TimeoutExpired:
            process.kill()
            killed += 1
        process.wait()
    assert main(stage_command(folder, stage)[3:]) == 0
    return folder


def assert_equal_results(folder, run, stage):
    """Everything up to the stage is the same to the last bit, and no half-written file is left."""
    results = sorted(
        path.relative_to(run)
        for path in run.rglob("*")
        if path.is_file() and path.name != "record.json"
    )
    later = {
        "autoencoder": ["mdn", "evo", "con"],
        "mdn_rnn": ["evo", "con"],
        "rollouts": ["aut", "mdn", "evo", "con"],
    }
    for path in results:
        if not path.name.startswith((".", *later.get(stage, []))):
            assert (folder / path).read_bytes() == (run / path).read_bytes(), path
    assert not list(folder.rglob("*.part"))


def test_a_killed_training_goes_on_to_the_same_bits(quick_run, tmp_path):
    assert_equal_results(
        kill_at_random("autoencoder", quick_run, tmp_path, 1), quick_run, "autoencoder"
    )


@pytest.mark.long
@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_killed_at_twenty_random_moments_ends_with_the_same_bits(
    stage, quick_run, tmp_path
):
    assert_equal_results(kill_at_random(stage, quick_run, tmp_path, 20), quick_run, stage)


def test_half_written_files_of_a_killed_process_are_cleared_away(
    quick_run, tmp_path, in_this_process
):
    folder = start_of("controller", quick_run, tmp_path / "run")
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    left_over, others = (
        folder / f".evolution.json.{ended.pid}.part",
        [".thesis.zip.part", f".log.{os.getppid()}.part"],
    )
    for name in (left_over.name, *others):
        (folder / name).write_bytes(b"{")
    evolve(VARIANT, SETTINGS, folder, in_this_process)
    assert not left_over.exists() and all(
        (folder / name).exists() for name in others
    )  # somebody's, or still written


# Workers


def test_work_of_a_killed_worker_is_done_again(tmp_path, capfd):
    with worker_processes(2) as executor:
        tasks = [
            (tmp_path / "marker", number) for number in range(600)
        ]  # many: it dies while others are handed in
        assert dict(run_tasks(executor, die_once, tasks)) == {
            number: number for number in range(600)
        }
    assert "a worker process was lost: starting new ones" in capfd.readouterr().err


def test_work_of_a_stuck_worker_is_done_again(tmp_path, capfd):
    with worker_processes(1) as executor:
        list(run_tasks(executor, int, [()]))  # from now on a worker starts at once
    with worker_processes(1, time_limit=1.5) as executor:
        assert dict(run_tasks(executor, hang_once, [(tmp_path / "marker", 7)])) == {0: 7}
    assert "they are stuck" in capfd.readouterr().err


def test_a_lost_worker_for_whom_there_is_no_new_one_is_told_at_once(monkeypatch):
    def refuse(self):
        raise OSError(24, "Too many open files")

    with worker_processes(1) as executor:
        monkeypatch.setattr(WorkerProcesses, "_new_pool", refuse)
        with pytest.raises(OSError, match="Too many open files"):
            list(run_tasks(executor, always_die, [()] * 3, time_limit=60))


def test_work_that_kills_every_worker_ends_in_an_error():
    with worker_processes(1) as executor, pytest.raises((TaskError, BrokenProcessPool)):
        list(run_tasks(executor, always_die, [()] * 300))


def test_an_executor_that_never_answers_ends_in_an_error():
    never = threading.Event()
    with ThreadPoolExecutor(1) as executor:
        with pytest.raises(TaskError, match="nothing was heard of the workers for 1 "):
            list(run_tasks(executor, never.wait, [()], time_limit=1))
        never.set()


def test_a_worker_killed_in_mid_generation_costs_nothing_but_time(quick_run, tmp_path):
    folder = start_of("controller", quick_run, tmp_path / "run")
    with worker_processes(2) as executor, ThreadPoolExecutor(1) as killer:

        def kill_one():
            deadline = time.time() + 120
            while not (folder / "evolution.json").exists() and time.time() < deadline:
                time.sleep(0.01)
            next(iter(executor.pool._processes.values())).kill()

        done = killer.submit(kill_one)
        evolve(VARIANT, SETTINGS, folder, executor)
        done.result()
        assert len(executor.lost) == 1
    assert_equal_results(folder, quick_run, "controller")


def test_an_environment_that_raises_stops_the_run_with_its_cause_and_the_run_goes_on_later(
    quick_run, tmp_path, monkeypatch, in_this_process
):
    folder, drive, calls = start_of("controller", quick_run, tmp_path / "run"), evolution.drive, []

    def fragile(*arguments, **named):
        calls.append(1)
        if len(calls) == 6:
            raise RuntimeError("the track has fallen apart")
        return drive(*arguments, **named)

    monkeypatch.setattr(evolution, "drive", fragile)
    with pytest.raises(
        TaskError, match="drive_group failed in a worker: RuntimeError: the track has fallen apart"
    ):
        evolve(VARIANT, SETTINGS, folder, in_this_process)
    assert 1 <= len(load_json(folder / "evolution.json")["generations"]) < SETTINGS.generations
    evolve(VARIANT, SETTINGS, folder, in_this_process)
    assert_equal_results(folder, quick_run, "controller")


# Folders and disks


def test_two_processes_do_not_share_a_run_folder(quick_run, tmp_path, capsys):
    folder = start_of("mdn_rnn", quick_run, tmp_path / "run")
    holder = (
        "import sys, time; from filelock import FileLock\n"  # as `locked` does, without its imports
    )
    holder += "with FileLock(sys.argv[1] + '/.lock'): print('held', flush=True); time.sleep(1000)"
    process = subprocess.Popen([sys.executable, "-c", holder, folder], stdout=subprocess.PIPE)
    assert process.stdout.readline().strip() == b"held"
    before = snapshot(folder)
    assert main([*stage_command(folder, "mdn_rnn")[3:]]) == 2
    assert (
        f"error: {folder} is in use by another process: wait until that has ended"
        in capsys.readouterr().err
    )
    assert snapshot(folder) == before
    process.kill()  # and the lock is free at once
    process.wait()
    assert main([*stage_command(folder, "mdn_rnn")[3:]]) == 0


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


def test_a_full_disk_stops_the_run_in_one_line_and_more_room_lets_it_go_on(
    small_disk, quick_run, capsys
):
    disk = small_disk(8)
    run = start_of("autoencoder", quick_run, disk / "run")
    (disk / "ballast").write_bytes(bytes(max(0, shutil.disk_usage(disk).free - 500_000)))
    assert main(stage_command(run, "autoencoder")[3:]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert re.match(
        r"error: .*could not be written \(No space left on device\): see to free room", error
    )
    assert not (run / "autoencoder.safetensors").exists()
    small_disk(64)
    assert main(stage_command(run, "autoencoder")[3:]) == 0
    assert_equal_results(run, quick_run, "autoencoder")


def test_a_read_only_folder_is_refused_before_any_work(small_disk, quick_run, capsys):
    disk = small_disk(64)
    run = start_of("mdn_rnn", quick_run, disk / "run")
    small_disk(64, "ro")
    assert main(stage_command(run, "mdn_rnn")[3:]) == 2
    assert (
        f"error: {run} is no folder to write to (Read-only file system): choose"
        in capsys.readouterr().err
    )
    begin = time.perf_counter()
    evaluation = [
        "evaluate",
        "--variant",
        VARIANT,
        "--path",
        quick_run,
        "--json",
        disk / "evaluation.json",
    ]
    assert main([str(argument) for argument in evaluation]) == 2
    assert "evaluation.json could not be written (Read-only file system)" in capsys.readouterr().err
    assert time.perf_counter() - begin < 10  # not after the drive


@pytest.mark.parametrize(
    ("refusals", "patience", "found"), [(2, 1.0, b"new"), (10_000, 0.1, b"old")]
)
def test_a_file_that_a_scanner_holds_for_a_moment_is_written_a_moment_later(
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
    with (
        contextlib.nullcontext()
        if found == b"new"
        else pytest.raises(OSError, match="could not be written")
    ):
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


@pytest.mark.skipif(
    os.name == "nt", reason="Windows cannot open a folder, so none is flushed there"
)
def test_a_share_that_cannot_flush_a_folder_takes_files_all_the_same(tmp_path, monkeypatch):
    flush = os.fsync

    def flush_files_alone(opened):
        if stat.S_ISDIR(os.fstat(opened).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        flush(opened)

    monkeypatch.setattr("os.fsync", flush_files_alone)
    write_bytes(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_bytes() == b"new"


def test_a_commit_is_only_that_of_the_checkout_that_the_library_lies_in(tmp_path, monkeypatch):
    if pipeline.git("rev-parse", "HEAD") is None:
        pytest.skip("this is no checkout that git reads")
    subprocess.run(["git", "init", "-q", tmp_path], check=True)
    who = ["-c", "user.name=somebody", "-c", "user.email=somebody@example.org"]
    subprocess.run(
        ["git", "-C", tmp_path, *who, "commit", "-q", "--allow-empty", "-m", "Begin a thesis"],
        check=True,
    )
    monkeypatch.setattr(
        "stad_lab.training.pipeline.__file__", str(shutil.copy(pipeline.__file__, tmp_path))
    )
    found = provenance("there")
    assert found["commit"] is None and found["uncommitted_changes"] is None


# Verify


def test_verify_drives_recorded_episodes_again(quick_run, capsys):
    assert main(["verify", str(quick_run)]) == 0
    told = capsys.readouterr().out.replace("log of CMA-ES", "log")
    found = dict(line.split(maxsplit=1) for line in told.splitlines())
    assert found["rollouts"] == "ok: 8 episodes, 480 frames"
    assert found["log"] == "ok: 4 generations lead to the same mean"
    assert re.fullmatch(r"ok: .* points, to the last bit as recorded", found["drives"])
    assert not any(outcome.startswith("FAILED") for outcome in found.values())


def test_verify_says_of_a_collection_that_was_stopped_how_far_it_is(quick_run, tmp_path):
    folder = shutil.copytree(quick_run / "rollouts", tmp_path / "rollouts")
    manifest = load_json(folder / "manifest.json")
    save_json(folder / "manifest.json", manifest | {"blocks": manifest["blocks"][:3]})
    assert verify_rollouts(folder) == f"none: 3 of {SETTINGS.episodes} episodes so far"
    (folder / "manifest.json").unlink()
    assert verify_rollouts(folder).startswith("none: ")


def test_verify_finds_a_return_that_no_drive_gives(quick_run, tmp_path, in_this_process, capsys):
    folder = shutil.copytree(quick_run, tmp_path / "run")
    log = load_json(folder / "evolution.json")
    log["generations"][log["best"]["generation"] - 1]["validation"]["returns"][0] += 0.001
    save_json(folder / "evolution.json", log)
    assert main(["verify", str(folder)]) == 1
    assert re.search(
        r"drives +FAILED: the record says \[.*\], now it was \[", capsys.readouterr().out
    )
    record = load_json(folder / "record.json")
    record["continued_with"] = [
        record["made_with"] | {"processor": "a processor with other last bits"}
    ]
    save_json(folder / "record.json", record)
    drives = verify(folder, in_this_process)["drives"]
    assert re.match(r"differs: .*; but processor is '.*' and was 'a processor with", drives)


def test_verify_drives_the_episodes_of_an_evaluation_again(whole, tmp_path, in_this_process):
    folder = shutil.copytree(whole, tmp_path / "run", ignore=shutil.ignore_patterns("rollouts"))
    assert verify(folder, in_this_process)["drives"].startswith("ok")
    told = load_json(folder / "evaluation.json")
    told["episodes"][0]["return"] += 0.001
    save_json(folder / "evaluation.json", told)
    assert verify(folder, in_this_process)["drives"].startswith("FAILED: the record says")


def test_verify_tells_of_a_controller_that_the_log_does_not_know_beside_all_that_is_well(
    quick_run, tmp_path, in_this_process
):
    folder = shutil.copytree(quick_run, tmp_path / "run")
    log = load_json(folder / "evolution.json")
    save_json(folder / "evolution.json", log | {"generations": log["generations"][:1]})
    found = verify(folder, in_this_process)
    assert found["rollouts"].startswith("ok")
    for part in ("C", "drives"):
        assert "does not come from the run that" in found[part] and found[part].startswith("FAILED")


@pytest.mark.parametrize(
    ("name", "part"),
    [("autoencoder.safetensors", "V"), ("mdn_rnn.safetensors", "M"), ("rollouts", "V")],
)
def test_verify_tells_of_a_part_of_another_run_on_its_own_line(
    name, part, whole, another, tmp_path, in_this_process
):
    folder = shutil.copytree(whole, tmp_path / "run", ignore=shutil.ignore_patterns(name))
    copy = shutil.copytree if name == "rollouts" else shutil.copy
    copy(another / name, folder / name)
    assert verify(folder, in_this_process)[part].startswith("FAILED")


def test_weights_without_a_log_or_an_evaluation_have_no_drives_to_verify(
    quick_run, tmp_path, in_this_process
):
    run = shutil.copytree(
        quick_run, tmp_path / "run", ignore=shutil.ignore_patterns("evolution.json", "rollouts")
    )
    found = verify(run, in_this_process)
    assert {name for name, outcome in found.items() if outcome.startswith("none")} >= {
        "log of CMA-ES",
        "C",
        "drives",
    }
    assert not [outcome for outcome in found.values() if outcome.startswith("FAILED")]


def test_a_longer_run_that_was_killed_on_its_way_is_well_and_not_at_its_end(
    quick_run, tmp_path, in_this_process
):
    run = shutil.copytree(quick_run, tmp_path / "run")
    longer = dataclasses.replace(SETTINGS, generations=8)

    def kill(generations):
        if len(generations) == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evolve(VARIANT, longer, run, in_this_process, watch=kill)
    assert load_json(run / "record.json")["settings"]["generations"] == 4
    found = verify(run, in_this_process)
    assert not [outcome for outcome in found.values() if outcome.startswith("FAILED")]
    assert found["log of CMA-ES"] == "ok: 6 generations lead to the same mean"
    with pytest.raises(ValueError, match="is not at its end, with 6 of 8 generations"):
        pipeline.read_finished(run)


def test_records_that_were_kept_without_their_weights_are_no_failure(in_this_process):
    found = verify(RECORDS / "no_M" / "seed0", in_this_process)
    assert not [outcome for outcome in found.values() if outcome.startswith("FAILED")]
    assert found["evaluations"].startswith("ok") and found["log of CMA-ES"].startswith("none")


@pytest.mark.parametrize("lost", ["autoencoder.safetensors", "mdn_rnn.safetensors"])
def test_a_run_that_has_lost_v_or_m_fails(lost, whole, tmp_path, in_this_process):
    run = shutil.copytree(whole, tmp_path / "run", ignore=shutil.ignore_patterns("rollouts", lost))
    found = verify(run, in_this_process)
    assert all(found[part].startswith("FAILED") for part in ("log of CMA-ES", "C"))


def test_a_driver_s_record_is_no_run_to_go_on_with(tmp_path):
    shutil.copy(RECORDS / "random_driver" / "seed0" / "record.json", tmp_path)
    with pytest.raises(
        ValueError,
        match="holds the record of random_driver, which is no run: choose another folder",
    ):
        train(VARIANT, SETTINGS, tmp_path)


def test_verify_says_of_a_driver_without_an_agent_that_there_is_nothing_to_verify(capsys):
    assert main(["verify", str(RECORDS / "random_driver" / "seed0")]) == 2
    assert (
        "random_driver, which has no V, M and C: there is nothing to verify"
        in capsys.readouterr().err
    )


# Security


def test_a_run_uses_no_network_and_writes_only_into_its_folder(quick_training):
    folder, process, _ = quick_training  # which the guard of conftest.py has watched
    assert "guarded" in process.stderr
    assert "forbidden" not in process.stderr
    names = {
        "rollouts",
        "autoencoder.safetensors",
        "mdn_rnn.safetensors",
        "evolution.json",
        "controller.safetensors",
    }
    assert {path.name for path in folder.iterdir()} == names | {"record.json", ".lock"}


def test_a_run_that_is_made_longer_says_so_in_its_record(tmp_path):
    pipeline.open_record(tmp_path, "input", SETTINGS, "there")
    (tmp_path / "evolution.json").touch()
    longer = dataclasses.replace(SETTINGS, generations=8)
    assert pipeline.open_record(tmp_path, "input", longer, "there")["settings"] == longer.as_dict()


def test_the_time_of_a_stage_is_that_of_all_its_starts(tmp_path, in_this_process):
    def stage(pool):
        time.sleep(0.05)
        if not (tmp_path / "record.json").exists():
            raise KeyboardInterrupt
        return True

    asked = (
        {"mdn_rnn": stage},
        ["mdn_rnn"],
        {"settings": SETTINGS.as_dict(), "seconds": {}},
        tmp_path,
        None,
    )
    with pytest.raises(KeyboardInterrupt):
        pipeline.run_stages(*asked, in_this_process)
    assert load_json(tmp_path / "record.json")["seconds"]["mdn_rnn"] >= 0.05
    pipeline.run_stages(*asked, in_this_process)
    record = load_json(tmp_path / "record.json")
    assert record["seconds"]["mdn_rnn"] >= 0.1 and len(record["peak_memory"]["mdn_rnn"]) == 2
