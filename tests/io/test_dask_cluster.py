"""Beyond one machine: a real Dask scheduler and four workers, processes of their own with their own addresses."""

import importlib.metadata
import json
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest
from distributed import Client, LocalCluster
from test_faults import VARIANT, assert_equal_results, start_of

from stad_lab.__main__ import main
from stad_lab.config import Settings
from stad_lab.evaluation.evaluate import evaluate
from stad_lab.io.dask_cluster import check_address, check_versions, cluster, versions
from stad_lab.io.files import load_json
from stad_lab.io.workers import TaskError, run_tasks
from stad_lab.replication import run as replication
from stad_lab.training.dataset import collect_rollouts
from stad_lab.training.evolution import evolve

WORKERS = 4
SETTINGS = Settings.preset("quick")


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """Its address, and the processes of its workers by their names."""
    folder, quiet = (
        tmp_path_factory.mktemp("cluster"),
        {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL},
    )
    quiet["env"] = os.environ | {
        "PYTHONPATH": str(Path(__file__).parents[1])
    }  # for the tasks that are written here
    dask, contact = [sys.executable, "-m", "dask"], folder / "scheduler.json"
    options = ["--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]
    processes = [
        subprocess.Popen(
            [*dask, "scheduler", *options, "--scheduler-file", contact], cwd=folder, **quiet
        )
    ]
    wait_for(contact.exists)
    time.sleep(0.5)
    address = load_address(contact)
    options = [
        "--nthreads",
        "1",
        "--no-nanny",
        "--no-dashboard",
        "--host",
        "127.0.0.1",
        "--local-directory",
        folder,
    ]
    workers = {
        f"worker{number}": subprocess.Popen(
            [*dask, "worker", address, "--name", f"worker{number}", *options], cwd=folder, **quiet
        )
        for number in range(WORKERS)
    }
    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(WORKERS, timeout=120)
    yield address, workers
    for process in [*workers.values(), *processes]:
        process.kill()
        process.wait()


def load_address(contact):
    """The address in a scheduler's contact file, which Dask writes (so it has no checksum of ours)."""
    return json.loads(contact.read_text(encoding="utf-8"))["address"]


def wait_for(condition, seconds=60):
    """Wait until a condition holds."""
    deadline = time.time() + seconds
    while not condition():
        assert time.time() < deadline
        time.sleep(0.05)


class Parcel:
    """Something to share that counts in every process how often it has arrived."""

    arrived = 0

    def __getstate__(self):
        return {"content": bytes(1000)}

    def __setstate__(self, state):
        type(self).arrived += 1


def open_parcel(parcel, number):
    """A task: where it ran, and how many parcels have arrived there."""
    time.sleep(0.05)
    return os.getpid(), type(parcel).arrived


def test_what_is_shared_travels_once_to_every_worker_and_not_with_each_task(scheduler):
    with cluster(scheduler[0]) as executor:
        parcel = executor.share(Parcel())
        time.sleep(
            2.5
        )  # longer than Dask's memory manager waits until it drops what no task is waiting for
        found = [
            future.result()
            for future in [executor.submit(open_parcel, parcel, number) for number in range(40)]
        ]
    assert len({process for process, _ in found}) == WORKERS
    assert max(arrived for _, arrived in found) == 1
    with Client(scheduler[0], set_as_default=False) as client:
        assert client.amm.running()  # again, as it was before


def test_a_collection_on_a_cluster_is_the_same_to_the_last_bit(scheduler, quick_run, tmp_path):
    with cluster(scheduler[0]) as executor:
        collect_rollouts(SETTINGS, tmp_path / "run" / "rollouts", executor)
    for path in (quick_run / "rollouts").glob("*.*"):
        assert (tmp_path / "run" / "rollouts" / path.name).read_bytes() == path.read_bytes()


def test_an_evaluation_on_a_cluster_is_the_same_to_the_last_bit(scheduler, straight_run):
    with cluster(scheduler[0]) as executor:
        far = evaluate(VARIANT, straight_run, 3, fast=True, executor=executor)
    with ThreadPoolExecutor(2) as executor:
        near = evaluate(VARIANT, straight_run, 3, fast=True, executor=executor)
    assert far["episodes"] == near["episodes"]


def test_the_command_line_evolves_on_a_cluster(scheduler, quick_run, tmp_path, capsys):
    folder = start_of("controller", quick_run, tmp_path / "run")
    command = [
        "train",
        "--variant",
        VARIANT,
        "--settings",
        "quick",
        "--scheduler",
        scheduler[0],
        "--out",
        str(folder),
    ]
    assert main(command) == 0
    assert_equal_results(folder, quick_run, "controller")


def test_the_command_line_makes_a_row_of_the_table_on_a_cluster(
    scheduler, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(replication, "TRACKS", 3)
    row, episodes = ["replicate", "--row", "gentle_driver", "--out"], []
    for folder, where in (("far", ["--scheduler", scheduler[0]]), ("near", [])):
        assert main([*row, str(tmp_path / folder), *where]) == 0
        episodes.append(
            load_json(tmp_path / folder / "gentle_driver" / "seed0" / "evaluation.json")["episodes"]
        )
    assert len(episodes[0]) == 3 and episodes[0] == episodes[1]
    assert "gentle_driver: at most" in capsys.readouterr().out


def test_a_worker_killed_in_mid_generation_costs_a_retry_and_not_the_run(
    scheduler, quick_run, tmp_path
):
    address, workers = scheduler
    folder = start_of("controller", quick_run, tmp_path / "run")
    with cluster(address) as executor:

        def kill_one():
            wait_for(find_one)
            workers[victims[0]].kill()

        def find_one():
            victims.extend(busy(executor)[: (folder / "evolution.json").exists()])
            return victims

        victims = []
        killer = threading.Thread(target=kill_one)
        killer.start()
        evolve(VARIANT, SETTINGS, folder, executor)
        killer.join()
        wait_for(lambda: len(executor._client.scheduler_info()["workers"]) == WORKERS - 1)
    assert len(victims) == 1
    assert len(load_json(folder / "evolution.json")["generations"]) == SETTINGS.generations
    assert_equal_results(folder, quick_run, "controller")


def busy(executor):
    """The names of the workers that have a task."""
    names = {
        address: worker["name"]
        for address, worker in executor._client.scheduler_info()["workers"].items()
    }
    return [
        names[address]
        for address, tasks in executor._client.processing().items()
        if tasks and address in names
    ]


def test_a_lost_scheduler_is_told_in_one_line_and_does_not_hide_what_was_done():
    lost = LocalCluster(n_workers=1, processes=False, protocol="tcp://", dashboard_address=None)
    with (
        lost,
        cluster(lost.scheduler_address) as executor,
    ):  # and to leave this block raises nothing
        executor._client.close()  # as it does by itself, a minute after it has lost its scheduler
        with pytest.raises(
            TaskError, match="what workers share failed in a worker: ClosedClientError"
        ):
            executor.share(b"V and M")
        with pytest.raises(TaskError, match="int failed in a worker: ClosedClientError"):
            list(run_tasks(executor, int, [()]))


def test_a_task_that_is_cancelled_from_outside_is_told_with_the_remedy():
    with (
        cancelling_executor() as executor,
        pytest.raises(TaskError, match="sleep was cancelled, as when a scheduler"),
    ):
        list(run_tasks(executor, time.sleep, [(1,)]))


@contextmanager
def cancelling_executor():
    """An executor that cancels every task, as Dask does with those of a lost scheduler."""
    with ThreadPoolExecutor(1) as executor:
        executor.submit(time.sleep, 0.2)  # keeps it busy, so that the next one can be cancelled
        submit = executor.submit
        executor.submit = lambda *task: cancelled(submit(*task))
        yield executor


def cancelled(future):
    """A future, cancelled."""
    assert future.cancel()
    return future


def test_an_address_without_a_scheduler_is_an_error_that_says_how_to_start_one():
    with (
        pytest.raises(
            OSError, match=r"no Dask scheduler answers at 'tcp://127.0.0.1:9'.*dask scheduler"
        ),
        cluster("tcp://127.0.0.1:9", patience=1),
    ):
        pass


@pytest.mark.parametrize(
    "address", ["127.0.0.1", "nonsense", "http://127.0.0.1:8787/status", "tls://127.0.0.1:9"]
)
def test_what_is_no_address_of_a_scheduler_is_refused_before_a_client_is_made(address, monkeypatch):
    monkeypatch.setattr("stad_lab.io.dask_cluster.Client", None)
    with (
        pytest.raises(ValueError, match=rf"'{address}': expected the address that it prints"),
        cluster(address),
    ):
        pass


def test_a_tls_address_may_be_tried_with_certificates(monkeypatch):
    found = {"ssl_context": object()}
    monkeypatch.setattr(
        "stad_lab.io.dask_cluster.Security.get_connection_args", lambda *given: found
    )
    check_address("tls://127.0.0.1:9")
    found.clear()
    with pytest.raises(ValueError, match="needs certificates"):
        check_address("tls://127.0.0.1:9")


def test_a_scheduler_without_workers_is_an_error_that_says_how_to_start_one():
    alone = LocalCluster(n_workers=0, processes=False, protocol="tcp://", dashboard_address=None)
    message = "has no worker after 1 seconds: start one with `dask worker tcp://"
    with alone, pytest.raises(OSError, match=message), cluster(alone.scheduler_address, patience=1):
        pass


def test_a_cluster_whose_workers_have_other_versions_is_refused(scheduler, monkeypatch):
    installed = importlib.metadata.version
    monkeypatch.setattr(
        "importlib.metadata.version", lambda name: "0.1" if name == "numpy" else installed(name)
    )
    with (
        pytest.raises(ValueError, match=r"worker tcp://.* has numpy .*, here it is 0\.1"),
        cluster(scheduler[0]),
    ):
        pass


def test_a_worker_that_lacks_a_package_is_refused(scheduler, monkeypatch):
    monkeypatch.setattr("stad_lab.io.dask_cluster.versions", lack_a_package)
    with (
        pytest.raises(ValueError, match=r"a worker of tcp://.* lacks a package \(.*nowhere"),
        cluster(scheduler[0]),
    ):
        pass


def lack_a_package():
    return {"nowhere": importlib.metadata.version("nowhere")}


def test_a_worker_with_other_versions_is_named():
    with pytest.raises(
        ValueError, match=r"worker tcp://far has torch 1.0, here it is .*install the same"
    ):
        check_versions({"tcp://near": versions(), "tcp://far": versions() | {"torch": "1.0"}})
