"""Worker processes: lost, stuck, interrupted, cancelled, suspended, or started by a wrong script."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import FIRST_COMPLETED, CancelledError, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import psutil
import pytest
from worker_tasks import always_die, die_once, note, send_much

import stad_lab
from stad_lab.io.workers import TaskError, WorkerProcesses, run_tasks, worker_processes

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
    return os.getppid(), "stad_lab.training.pipeline" in sys.modules


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere workers import what they need")
def test_the_workers_of_all_pools_come_from_one_process_that_has_imported_the_library():
    parents = []
    for _ in range(2):
        with worker_processes(1) as executor:
            ((_, (parent, imported)),) = run_tasks(executor, parent_and_imports, [()])
        assert imported and parent != os.getpid()
        parents.append(parent)
    assert parents[0] == parents[1]


def test_the_work_of_a_killed_worker_is_done_again(tmp_path, capfd):
    with worker_processes(2) as executor:  # many tasks: it dies while others are handed in
        tasks = [(tmp_path / "marker", number) for number in range(600)]
        found = dict(run_tasks(executor, die_once, tasks))
    assert found == {number: number for number in range(600)}
    assert "a worker process was lost: its work is done again" in capfd.readouterr().err


def test_work_that_kills_every_worker_ends_in_an_error():
    with (
        worker_processes(1) as executor,
        pytest.raises((TaskError, BrokenProcessPool), match=r"4 times in a row a worker process"),
    ):
        list(run_tasks(executor, always_die, [()] * 300))


def test_a_lost_pool_that_cannot_be_replaced_is_an_error_at_once(monkeypatch):
    def refuse(self):
        raise OSError(24, "Too many open files")

    with worker_processes(1) as executor:
        monkeypatch.setattr(WorkerProcesses, "_new_pool", refuse)
        with pytest.raises(OSError, match="Too many open files"):
            list(run_tasks(executor, always_die, [()] * 3, patience=60))


def test_an_executor_that_never_answers_ends_in_an_error():
    never = threading.Event()
    with ThreadPoolExecutor(1) as executor:
        with pytest.raises(TaskError, match="no worker has finished anything for 1 seconds"):
            list(run_tasks(executor, never.wait, [()], patience=1))
        never.set()


def test_a_cancelled_task_does_not_begin_and_whoever_waits_for_it_learns_that(tmp_path):
    with worker_processes(1) as executor:
        futures = [executor.submit(note, tmp_path, number) for number in range(12)]
        assert not any(future.running() for future in futures)
        assert futures[0].result() == 0
        assert all(future.cancel() for future in futures[6:])
        done, _ = wait(futures[6:], timeout=5, return_when=FIRST_COMPLETED)
        assert done
        with pytest.raises(CancelledError):
            futures[11].result(timeout=5)
        assert [future.result() for future in futures[1:6]] == [1, 2, 3, 4, 5]
        assert executor.submit(note, tmp_path, 12).result() == 12
    assert {int(path.name) for path in tmp_path.iterdir()} == {0, 1, 2, 3, 4, 5, 12}


def test_the_tasks_of_an_aborted_call_do_not_go_on(tmp_path):
    with worker_processes(1) as executor:
        for _ in run_tasks(executor, note, [(tmp_path, number) for number in range(50)]):
            break
        assert executor.submit(note, tmp_path, 50).result(timeout=10) == 50
    assert len(list(tmp_path.iterdir())) < 10


def test_a_task_that_is_cancelled_from_outside_is_an_error_with_its_remedy():
    with ThreadPoolExecutor(1) as executor:
        executor.submit(time.sleep, 0.2)  # keeps it busy, so that the next one can be cancelled
        submit = executor.submit

        def submit_and_cancel(*task):
            future = submit(*task)
            assert future.cancel()
            return future

        executor.submit = submit_and_cancel
        with pytest.raises(TaskError, match="sleep was cancelled, as when a scheduler"):
            list(run_tasks(executor, time.sleep, [(1,)]))


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


@pytest.mark.parametrize(
    "call",
    [
        "from stad_lab.training.pipeline import train; train(Config.preset('quick'), 'run')",
        "from stad_lab.evaluation.evaluate import evaluate; evaluate('input', 2, fast=True)",
    ],
)
def test_a_script_without_a_main_guard_ends_with_one_line_that_says_what_to_do(call, tmp_path):
    process = run_script(tmp_path, f"from stad_lab import Config\n{call}\n")
    lines = process.stderr.splitlines()
    assert process.returncode == 1
    assert 'script.py would run again in every worker process: put what it does below' in lines[-1]
    assert 'if __name__ == "__main__":' in lines[-1]
    assert process.stderr.count("Traceback") == 1 and "BrokenProcessPool" not in process.stderr
    assert not (tmp_path / "run").exists()


def test_a_script_without_a_main_guard_may_train_with_an_executor_of_its_own(tmp_path):
    text = """
from concurrent.futures import ThreadPoolExecutor
from stad_lab import Config
from stad_lab.training.pipeline import train
config = Config.preset("quick", data={"episodes": 2, "episode_frames": 30})
with ThreadPoolExecutor(1) as executor:
    print(train(config, "run", until="dataset", executor=executor))
"""
    process = run_script(tmp_path, text)
    assert process.stdout.splitlines()[-1:] == ["True"], process.stderr


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


SUSPENDED = """
import time
from stad_lab.io.workers import run_tasks, worker_processes

if __name__ == "__main__":
    with worker_processes(1) as executor:
        list(run_tasks(executor, time.sleep, [(0,)]))  # now a worker has started
        tasks = run_tasks(executor, time.sleep, [(1,)], patience=3)
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
        os.killpg(process.pid, signal.SIGSTOP)
        time.sleep(4)
        os.killpg(process.pid, signal.SIGCONT)
        output, errors = process.communicate(timeout=60)
    assert (process.returncode, output, errors) == (0, "[(0, None)]\n", "")
