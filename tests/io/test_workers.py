"""Workers: killed, stuck, interrupted, cancelled, suspended, or started by a wrong script."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from worker_tasks import always_die, note

import stad_lab
from stad_lab.agent import rollout
from stad_lab.envs.cars import Cars
from stad_lab.io.workers import (
    TaskError,
    run_tasks,
    single_thread,
    worker_processes,
    worker_threads,
)
from stad_lab.training.dataset import RandomDriver

unix = pytest.mark.skipif(sys.platform == "win32", reason="Windows suspends no process by a signal")


def run_script(folder, text, **environment):
    """Run a script in a process of its own."""
    script = folder / "script.py"
    script.write_text(text)
    command = [sys.executable, "-W", "ignore", script]
    options = {"cwd": folder, "capture_output": True, "text": True, "timeout": 120}
    return subprocess.run(command, env=os.environ | environment, check=False, **options)


def parent_and_imports():
    """A task: the process that started this worker, and whether the library was imported there."""
    return os.getppid(), "stad_lab.training.evolution" in sys.modules


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere workers import what they need")
def test_the_workers_of_all_pools_come_from_one_process_that_has_imported_the_library():
    parents = []
    for _ in range(2):
        with worker_processes(1) as executor:
            ((_, (parent, imported)),) = run_tasks(executor, parent_and_imports, [()])
        assert imported and parent != os.getpid()
        parents.append(parent)
    assert parents[0] == parents[1]


def test_a_killed_worker_process_ends_the_call_with_one_line():
    with worker_processes(1) as executor, pytest.raises(TaskError, match="ended abruptly"):
        list(run_tasks(executor, always_die, [()] * 3))


def test_the_rollouts_of_a_stopped_pool_of_threads_end_within_a_frame():
    cars = Cars(1, "frame")
    cars.reset([1])
    began, begin = threading.Event(), time.perf_counter()

    class Slow(RandomDriver):
        def act(self):
            began.set()
            time.sleep(0.01)
            return super().act()

    with pytest.raises(KeyboardInterrupt), worker_threads(1) as executor:
        future = executor.submit(rollout, Slow(np.random.default_rng(0)), cars)
        began.wait()
        raise KeyboardInterrupt
    assert time.perf_counter() - begin < 1.0
    assert isinstance(future.exception(), CancelledError)


def test_threads_leave_the_number_of_threads_of_torch_as_it_was():
    torch.set_num_threads(2)  # the tasks set it to 1, for all threads that come later
    try:
        with worker_threads(2) as executor:
            list(run_tasks(executor, single_thread, [(), ()]))
        with ThreadPoolExecutor(1) as later:
            assert later.submit(torch.get_num_threads).result() == 2
    finally:
        torch.set_num_threads(1)


def test_an_executor_that_never_answers_ends_in_an_error():
    never = threading.Event()
    with ThreadPoolExecutor(1) as executor:
        with pytest.raises(TaskError, match="no worker has finished anything for 1 seconds"):
            list(run_tasks(executor, never.wait, [()], patience=1))
        never.set()


def test_the_tasks_of_an_aborted_call_do_not_go_on(tmp_path):
    with worker_processes(1) as executor:
        for _ in run_tasks(executor, note, [(tmp_path, number) for number in range(50)]):
            break
        assert executor.submit(note, tmp_path, 50).result(timeout=10) == 50
    assert len(list(tmp_path.iterdir())) < 10


# Python itself loses an interrupt that comes in a callback of the garbage collector: a second later
# there is another one. A thread that waits for ever would keep the script from ending.
INTERRUPTED = """
import random, signal, time
from stad_lab.io.workers import run_tasks, worker_threads

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's "&" lets it be ignored
signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
for number in range(600):
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.002 + 0.005 * random.random(), 1.0)
        while True:
            with worker_threads(2) as executor:
                list(run_tasks(executor, time.sleep, [(0,)] * 300))
    except KeyboardInterrupt:
        signal.setitimer(signal.ITIMER_REAL, 0)
print("ended")
"""


@unix
def test_ctrl_c_ends_the_tasks_at_whatever_moment_it_comes(tmp_path):
    process = run_script(tmp_path, INTERRUPTED)
    assert process.stdout == "ended\n", process.stderr


def test_a_task_that_is_cancelled_from_outside_is_an_error_with_its_remedy():
    busy = threading.Event()
    with ThreadPoolExecutor(1) as executor:
        executor.submit(busy.wait, 10)  # keeps it busy, so that the next one can be cancelled
        submit = executor.submit

        def submit_and_cancel(*task):
            future = submit(*task)
            assert future.cancel()
            return future

        executor.submit = submit_and_cancel
        with pytest.raises(TaskError, match="sleep was cancelled, as when a scheduler"):
            list(run_tasks(executor, time.sleep, [(1,)]))
        busy.set()


def test_on_windows_there_are_as_many_processes_as_it_can_wait_for(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    with worker_processes(64) as executor:
        assert executor._max_workers == 61


def test_no_more_results_wait_to_be_taken_than_are_asked_for():
    begun = []
    with ThreadPoolExecutor(2) as executor:
        tasks = run_tasks(executor, begun.append, [(number,) for number in range(20)], ahead=3)
        for taken, _ in enumerate(tasks, 1):
            time.sleep(0.01)  # whatever may begin has begun
            assert len(begun) <= min(20, taken + 3)
    assert sorted(begun) == list(range(20))


def test_a_script_without_a_main_guard_may_train_and_where_it_needs_processes_ends_in_one_line(
    tmp_path,
):
    text = """
from stad_lab import Config
from stad_lab.evaluation.evaluate import evaluate
from stad_lab.training.pipeline import train
config = Config.preset("quick", data={"episodes": 2, "episode_frames": 30})
print(train(config, "run", until="dataset"))
evaluate("input", 2)
"""
    process = run_script(tmp_path, text)
    assert process.stdout.splitlines()[-1:] == ["True"], process.stderr
    lines = process.stderr.splitlines()
    assert process.returncode == 1
    assert "script.py would run again in every worker process: put what it does below" in lines[-1]
    assert 'if __name__ == "__main__":' in lines[-1]
    assert process.stderr.count("Traceback") == 1 and "BrokenProcessPool" not in process.stderr


ANOTHER = """
import sys
sys.path.insert(0, {folder!r})
import stad_lab
from stad_lab.io.workers import run_tasks, worker_processes

if __name__ == "__main__":
    print(stad_lab.__file__)
    with worker_processes(1) as executor:
        print(list(run_tasks(executor, int, [()])))
"""


def test_a_worker_that_loaded_another_stad_lab_is_refused(tmp_path):
    home = Path(stad_lab.__file__).parent
    another = tmp_path / "another"
    ignored = shutil.ignore_patterns("pretrained", "records", "__pycache__")
    shutil.copytree(home, another / "stad_lab", ignore=ignored)
    text = ANOTHER.format(folder=str(another))
    process = run_script(tmp_path, text, PYTHONPATH=str(home.parent))
    assert process.stdout.splitlines() == [str(another / "stad_lab" / "__init__.py")]
    message = f"a worker process loaded {home / '__init__.py'}, its parent {another}"
    assert process.stderr.splitlines()[-1].startswith(f"ValueError: {message}"), process.stderr


def test_workers_start_though_the_temporary_folder_has_a_long_name(tmp_path):
    folder = tmp_path / "a folder with a long name".ljust(80, "g")
    folder.mkdir()
    text = ORPHAN.replace("time.sleep(1000)", "pass")
    process = run_script(tmp_path, text, TMPDIR=str(folder))
    assert process.returncode == 0 and process.stdout.strip().isdigit(), process.stderr


SUSPENDED = """
import time
from stad_lab.io.workers import PRELOADED, run_tasks, worker_processes

if __name__ == "__main__":
    PRELOADED.clear()  # which takes long, and is needed for nothing here
    with worker_processes(1) as executor:
        list(run_tasks(executor, time.sleep, [(0,)]))  # now a worker has started
        tasks = run_tasks(executor, time.sleep, [(1.0,)], patience=2)
        print("begun", flush=True)
        print(list(tasks))
"""
ORPHAN = """
import os, time
from stad_lab.io.workers import PRELOADED, run_tasks, worker_processes

if __name__ == "__main__":
    PRELOADED.clear()
    with worker_processes(1) as executor:
        print(next(run_tasks(executor, os.getpid, [()]))[1], flush=True)
        time.sleep(1000)
"""


def start_script(folder, text):
    """Start a script, with pipes from its output and its errors."""
    (folder / "script.py").write_text(text)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    command = [sys.executable, "-W", "ignore", folder / "script.py"]
    return subprocess.Popen(command, start_new_session=True, **pipes)


def lives(process):
    """Whether a process of psutil still does anything."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_workers_end_when_the_process_that_started_them_is_killed(tmp_path):
    with start_script(tmp_path, ORPHAN) as process:
        worker = psutil.Process(int(process.stdout.readline()))
        process.kill()
    deadline = time.time() + 30
    while lives(worker):
        assert time.time() < deadline
        time.sleep(0.05)


@unix
def test_a_run_that_was_suspended_for_longer_than_its_patience_continues(tmp_path):
    with start_script(tmp_path, SUSPENDED) as process:
        assert process.stdout.readline() == "begun\n"
        time.sleep(0.5)  # now it waits for the task
        os.killpg(process.pid, signal.SIGSTOP)
        time.sleep(2.6)
        os.killpg(process.pid, signal.SIGCONT)
        output, errors = process.communicate(timeout=60)
    assert (process.returncode, output, errors) == (0, "[(0, None)]\n", "")
