"""A real Dask scheduler and two workers, processes of their own with their own addresses."""

import importlib.metadata
import json
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest
from distributed import Client, LocalCluster
from test_faults import assert_equal_results, start_of

from stad_lab.cli import main
from stad_lab.config import Config
from stad_lab.evaluation.evaluate import evaluate
from stad_lab.io.dask_cluster import check_address, check_versions, cluster, versions
from stad_lab.io.files import load_json
from stad_lab.io.workers import TaskError, run_tasks
from stad_lab.training.evolution import LOG, evolve
from stad_study import cli as study
from stad_study.study import STUDIES, Study, evaluate_kept, run_study

WORKERS = 2
QUICK = Config.preset("quick")


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """Its address, and the processes of its workers by their names."""
    folder = tmp_path_factory.mktemp("cluster")
    contact, dask = folder / "scheduler.json", [sys.executable, "-m", "dask"]
    # The path is for the tasks that are written in this file.
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]),
        "DASK_DISTRIBUTED__SCHEDULER__ACTIVE_MEMORY_MANAGER__INTERVAL": "200ms",
    }
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    quiet |= {"cwd": folder, "env": environment}
    options = ["--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]
    command = [*dask, "scheduler", *options, "--scheduler-file", contact]
    processes = [subprocess.Popen(command, **quiet)]
    wait_for(lambda: contact.exists() and contact.read_text(encoding="utf-8").endswith("}"))
    address = json.loads(contact.read_text(encoding="utf-8"))["address"]
    options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"]
    command = [*dask, "worker", address, *options, "--local-directory", folder]
    names = [f"worker{number}" for number in range(WORKERS)]
    workers = {name: subprocess.Popen([*command, "--name", name], **quiet) for name in names}
    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(WORKERS, timeout=120)
    yield address, workers
    for process in [*workers.values(), *processes]:
        process.kill()
        process.wait()


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


def test_what_is_shared_is_sent_once_to_every_worker_and_not_with_each_task(scheduler):
    with cluster(scheduler[0]) as executor:
        parcel = executor.share(Parcel())
        time.sleep(0.6)  # longer than Dask's memory manager keeps what no task waits for
        futures = [executor.submit(open_parcel, parcel, number) for number in range(12)]
        found = [future.result() for future in futures]
    assert len({process for process, _ in found}) == WORKERS
    assert max(arrived for _, arrived in found) == 1
    with Client(scheduler[0], set_as_default=False) as client:
        assert client.amm.running()  # again, as it was before


@contextmanager
def only_far():
    """A pool of this machine's own workers is an error."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stad_lab.io.workers.check_count", None)
        yield


def test_an_evaluation_on_a_cluster_is_bit_identical(scheduler, straight_run):
    with only_far(), cluster(scheduler[0]) as executor:
        far = evaluate(straight_run, 3, fast=True, executor=executor)
    with ThreadPoolExecutor(2) as executor:
        near = evaluate(straight_run, 3, fast=True, executor=executor)
    assert far["episodes"] == near["episodes"]


def test_the_command_line_evolves_on_a_cluster(scheduler, quick_run, tmp_path):
    folder = start_of("controller", quick_run, tmp_path / "run")
    command = ["train", "quick", "--variant", "input_output", "--out", str(folder)]
    with only_far():
        assert main([*command, "--scheduler", scheduler[0]]) == 0
    assert_equal_results(folder, quick_run, "controller")


def test_the_command_line_runs_an_experiment_on_a_cluster(scheduler, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("stad_study.run.TRACKS", 3)
    command, episodes = ["replicate", "constant_driver", "--out"], []
    for name, where in (("far", ["--scheduler", scheduler[0]]), ("near", [])):
        with only_far() if where else nullcontext():
            assert study.main([*command, str(tmp_path / name), *where]) == 0
        result = tmp_path / name / "constant_driver" / "seed0" / "evaluation.json"
        episodes.append(load_json(result)["episodes"])
    assert len(episodes[0]) == 3 and episodes[0] == episodes[1]
    assert "constant_driver: " in capsys.readouterr().out


def test_the_command_line_runs_a_study_on_a_cluster(scheduler, tmp_path, monkeypatch, capsys):
    evolution = {"generations": 2, "max_frames": 20, "components": 4}
    config = QUICK.replace(vae={"steps": 4}, mdn_rnn={"steps": 2}, evolution=evolution)
    brief = Study((0,), ("input_output",), ("z, h",), config, range(1000, 1003), 20)
    monkeypatch.setitem(STUDIES, "brief", brief)
    monkeypatch.setattr(run_study, "__defaults__", (None, None, None, tmp_path / "data"))
    monkeypatch.setattr(
        evaluate_kept, "__defaults__", (None, None, tmp_path / "networks", None, ())
    )
    name, far, episodes = "seed0/input_output/z_h", ["--scheduler", scheduler[0]], []
    with only_far():
        assert study.main(["replicate", "brief", "--out", str(tmp_path / "far"), *far]) == 0
    assert study.main(["replicate", "brief", "--only", name, "--out", str(tmp_path / "near")]) == 0
    assert f"{name}: bit-identical to the recorded one, all 3 returns" in capsys.readouterr().out
    for where in (far, []):
        scores = tmp_path / f"{len(episodes)}.json"
        drive = ["evaluate", "brief", "--first-track", "7", "--episodes", "2"]
        with only_far() if where else nullcontext():
            assert study.main([*drive, "--json", str(scores), *where]) == 0
        episodes.append(load_json(scores)["agents"][name]["episodes"])
    assert len(episodes[0]) == 2 and episodes[0] == episodes[1]


def test_a_worker_killed_in_the_middle_of_a_generation_costs_a_retry_and_not_the_run(
    scheduler, quick_run, tmp_path
):
    address, workers = scheduler
    folder, victims = start_of("controller", quick_run, tmp_path / "run"), []
    with cluster(address) as executor:

        def find_one():
            victims.extend(busy(executor)[: (folder / LOG).exists()])
            return victims

        def kill_one():
            wait_for(find_one)
            workers[victims[0]].kill()

        killer = threading.Thread(target=kill_one)
        killer.start()
        evolve(QUICK, folder, executor)
        killer.join()
        wait_for(lambda: len(executor._client.scheduler_info()["workers"]) == WORKERS - 1)
    assert len(victims) == 1
    assert len(load_json(folder / LOG)["generations"]) == QUICK.evolution.generations
    assert_equal_results(folder, quick_run, "controller")


def busy(executor):
    """The names of the workers that have a task."""
    known = executor._client.scheduler_info()["workers"]
    processing = executor._client.processing()
    return [known[one]["name"] for one, tasks in processing.items() if tasks and one in known]


def test_a_lost_scheduler_is_an_error_in_one_line_and_leaving_the_block_raises_nothing():
    lost = LocalCluster(n_workers=1, processes=False, protocol="tcp://", dashboard_address=None)
    with lost, cluster(lost.scheduler_address) as executor:
        executor._client.close()  # as it does a minute after it has lost its scheduler
        with pytest.raises(TaskError, match="share failed in a worker: ClosedClientError"):
            executor.share(b"V and M")
        with pytest.raises(TaskError, match="int failed in a worker: ClosedClientError"):
            list(run_tasks(executor, int, [()]))


def test_an_address_without_a_scheduler_is_an_error_with_its_remedy():
    error = r"no Dask scheduler answers at 'tcp://127.0.0.1:9'.*dask scheduler"
    with pytest.raises(OSError, match=error), cluster("tcp://127.0.0.1:9", patience=1):
        pass


@pytest.mark.parametrize(
    "address",
    [
        "127.0.0.1",
        "nonsense",
        "http://127.0.0.1:8787/status",
        "tls://127.0.0.1:9",
        "tcp://127.0.0.1:0",
        "tcp://127.0.0.1:99999",
    ],
)
def test_what_is_no_address_is_refused_before_a_client_is_made(address, monkeypatch):
    monkeypatch.setattr("stad_lab.io.dask_cluster.Client", None)
    error = rf"'{address}' .*: expected the address that it prints"
    with pytest.raises(ValueError, match=error), cluster(address):
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


def test_a_scheduler_without_workers_is_an_error_with_its_remedy():
    alone = LocalCluster(n_workers=0, processes=False, protocol="tcp://", dashboard_address=None)
    error = "has no worker after 1 s: start one with `dask worker tcp://"
    with alone, pytest.raises(OSError, match=error), cluster(alone.scheduler_address, patience=1):
        pass


def test_a_cluster_whose_workers_have_other_versions_is_refused(scheduler, monkeypatch):
    installed = importlib.metadata.version
    monkeypatch.setattr(
        "importlib.metadata.version", lambda name: "0.1" if name == "numpy" else installed(name)
    )
    error = r"worker tcp://.* has numpy .*, here it is 0\.1"
    with pytest.raises(ValueError, match=error), cluster(scheduler[0]):
        pass


def test_a_worker_that_lacks_a_package_is_refused(scheduler, monkeypatch):
    monkeypatch.setattr("stad_lab.io.dask_cluster.versions", lack_a_package)
    error = r"worker of tcp://.* lacks a package \(.*nowhere"
    with pytest.raises(ValueError, match=error), cluster(scheduler[0]):
        pass


def lack_a_package():
    return {"nowhere": importlib.metadata.version("nowhere")}


def test_a_worker_with_other_versions_is_named():
    found = {"tcp://near": versions(), "tcp://far": versions() | {"torch": "1.0"}}
    with pytest.raises(ValueError, match=r"worker tcp://far has torch 1.0, here it is .*install"):
        check_versions(found)
