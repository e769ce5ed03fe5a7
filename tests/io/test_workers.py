"""Workers: where they come from, and memory that is kept for the next step, but not without bound."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import psutil
import pytest

from stad_lab.evaluation.evaluate import evaluate
from stad_lab.io.workers import WorkerProcesses, has_glibc, peak_memory, run_tasks, worker_processes

FREED = """
import numpy as np
from pathlib import Path
from stad_lab.io.workers import keep_freed_memory, return_freed_memory

def held():
    return int(Path("/proc/self/status").read_text(encoding="utf-8").split("VmRSS:")[1].split()[0]) / 1e3

keep_freed_memory()
begin = held()
large = [np.ones(4_000_000, np.uint8) for _ in range(100)]
del large
kept = held() - begin
return_freed_memory(above=1e12)
still = held() - begin
return_freed_memory(above=100e6)
print(kept, still, held() - begin)
"""


def tell_parent():
    """A task: the process that started this worker, and whether the library had been imported there."""
    return os.getppid(), "stad_lab.training.pipeline" in sys.modules


@pytest.mark.skipif(
    sys.platform != "linux", reason="elsewhere workers import what they need themselves"
)
def test_the_workers_of_all_pools_come_from_one_process_that_has_imported_the_library():
    parents = []
    for _ in range(2):
        with worker_processes(1) as executor:
            ((_, (parent, imported)),) = run_tasks(executor, tell_parent, [()])
        assert imported and parent != os.getpid()
        parents.append(parent)
        assert 50 < peak_memory(executor)["worker"] < 3000
    assert parents[0] == parents[1]
    assert "worker" not in peak_memory()


def test_a_script_that_its_workers_read_again_learns_the_remedy(tmp_path):
    script, call = tmp_path / "script.py", "train('input', Settings.preset('quick'), 'run')"
    script.write_text(
        f"from stad_lab import Settings\nfrom stad_lab.training.pipeline import train\n{call}\n"
    )
    command = [sys.executable, "-W", "ignore", script]
    process = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert process.returncode != 0
    assert (
        'below a line `if __name__ == "__main__":`' in process.stderr
        and "in use by another" not in process.stderr
    )


def test_whoever_evaluates_in_a_worker_that_is_just_starting_learns_the_remedy(monkeypatch):
    monkeypatch.setattr(multiprocessing.current_process(), "_inheriting", True, raising=False)
    with pytest.raises(RuntimeError, match="below a line `if __name__"):
        evaluate("input", episodes=2, first_track=100, fast=True)


def test_on_windows_there_are_as_many_processes_as_it_can_wait_for(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    with WorkerProcesses(64) as executor:
        assert executor.pool._max_workers == 61


def test_no_more_results_wait_to_be_taken_than_are_asked_for():
    begun = []
    with ThreadPoolExecutor(2) as executor:
        tasks = run_tasks(executor, begun.append, [(number,) for number in range(20)], ahead=3)
        for taken, _ in enumerate(tasks, 1):
            time.sleep(0.01)  # whatever may begin has begun
            assert len(begun) <= min(20, taken + 3)
    assert sorted(begun) == list(range(20))


SUSPENDED = """
import sys, time
from stad_lab.io.workers import run_tasks, worker_processes

if __name__ == "__main__":
    with worker_processes(1) as executor:
        list(run_tasks(executor, time.sleep, [(0,)]))  # a worker has started, which may take seconds
        executor.time_limit = 3
        tasks = run_tasks(executor, time.sleep, [(1,)], time_limit=3)
        print("begun", flush=True)
        print(list(tasks))
"""


ORPHAN = """
import os, time
from stad_lab.io.workers import run_tasks, worker_processes

if __name__ == "__main__":
    with worker_processes(1) as executor:
        print(next(run_tasks(executor, os.getpid, [()]))[1], flush=True)
        time.sleep(1000)
"""


def lives(process):
    """Whether a process of psutil still does anything."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_workers_end_when_the_process_that_started_them_is_killed(tmp_path):
    (tmp_path / "script.py").write_text(ORPHAN)
    command = [sys.executable, "-W", "ignore", tmp_path / "script.py"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        worker = psutil.Process(int(process.stdout.readline()))
        process.kill()
    deadline = time.time() + 30
    while lives(worker):
        assert time.time() < deadline
        time.sleep(0.05)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows suspends no process by a signal")
def test_a_run_that_was_suspended_for_longer_than_its_patience_goes_on(tmp_path):
    (tmp_path / "script.py").write_text(SUSPENDED)
    command = [sys.executable, "-W", "ignore", tmp_path / "script.py"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, start_new_session=True, **pipes) as process:
        assert process.stdout.readline() == "begun\n"
        os.killpg(process.pid, signal.SIGSTOP)
        time.sleep(4)
        os.killpg(process.pid, signal.SIGCONT)
        told, complaints = process.communicate(timeout=60)
    assert (process.returncode, told, complaints) == (0, "[(0, None)]\n", "")


def send_much():
    """A task whose result is a long while on its way to the parent."""
    return bytes(300_000_000)


def test_an_interrupt_while_a_worker_sends_its_result_does_not_hang():
    ends = []

    def interrupted():
        with pytest.raises(KeyboardInterrupt), worker_processes(1) as executor:
            executor.submit(send_much)
            while not executor.pool._result_queue._reader.poll(0.001):
                pass
            time.sleep(0.01)  # some of it has come
            raise KeyboardInterrupt
        ends.append("at once")

    thread = threading.Thread(target=interrupted, daemon=True)
    thread.start()
    thread.join(60)
    assert ends == ["at once"]


@pytest.mark.skipif(not has_glibc(), reason="only glibc is told to keep memory")
def test_freed_memory_is_kept_and_returned_when_the_process_holds_too_much():
    process = subprocess.run(
        [sys.executable, "-c", FREED], capture_output=True, text=True, timeout=60
    )
    assert process.returncode == 0, process.stderr
    kept, still, returned = map(float, process.stdout.split())
    assert kept > 350
    assert still > 350
    assert returned < 50
