"""Beyond one machine: the workers of a Dask cluster in place of this machine's own processes.

Collecting, evolving and evaluating take any `concurrent.futures.Executor`, and this is Dask's. Episodes depend on their
seeds alone, so a cluster changes how long a run takes and nothing else (on other processors the last bits, as ever).
"""

import importlib.metadata
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from distributed import Client, Future, Security
from distributed.cfexecutor import ClientExecutor
from distributed.comm import get_address_host_port, parse_address

from stad_lab.io.workers import task_errors

PATIENCE = 60.0  # seconds to wait for a scheduler to answer and for its first worker
# Versions that differ would give other numbers.
SAME = ("stad_lab", "torch", "numpy", "gymnasium", "box2d", "pygame-ce", "opencv-python-headless")


class ClusterExecutor(ClientExecutor):
    """Dask's executor, which does the work of a lost worker again; and with a way to share something large."""

    def share(self, value: Any) -> Future:
        """A stand-in for `value` in the arguments of tasks: every worker gets it once.

        It is the result of a task, not data that was put there, so it comes back if the workers that held it are lost.
        All workers get it at once, because Dask prefers to send a task to where its arguments are.

        Raises:
            TaskError: the scheduler is lost, or all workers are.
        """
        once = {
            "allow_other_workers": True,
            "pure": False,
        }  # another one may do it if that one is lost before it could
        with warnings.catch_warnings(), task_errors("what workers share"):
            warnings.filterwarnings(
                "ignore", "Sending large graph"
            )  # once for each run, not for each task
            stand_in = self._client.submit(itself, value, pure=False)
            fetched = [
                self._client.submit(fetch, stand_in, workers=[one], **once)
                for one in self._client.nthreads()
            ]
            for future in fetched:
                future.result()
        return stand_in


def fetch(value: Any) -> None:
    """Nothing: but whoever calls this has got the value."""


def itself(value: Any) -> Any:
    """What it is given."""
    return value


@contextmanager
def cluster(address: str, patience: float = PATIENCE) -> Iterator[ClusterExecutor]:
    """The workers of the Dask scheduler at `address`, as an executor, for a `with` block.

    Args:
        address: for example "tcp://10.0.0.1:8786", as `dask scheduler` prints it.
        patience: seconds to wait for it, and for a worker.

    Raises:
        OSError: no scheduler answers, or it has no worker.
        ValueError: no address of a scheduler; or a worker that is there by now lacks a package, or has another version
            than this process, and so would drive otherwise.
    """
    check_address(address)
    try:
        client = Client(address, timeout=patience, set_as_default=False)
    except OSError as error:
        raise ConnectionError(
            f"no Dask scheduler answers at {address!r} ({error}): start one with `dask scheduler`, and give the address"
            " that it prints"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=patience)
        except TimeoutError as error:
            raise ConnectionError(
                f"the scheduler at {address} has no worker after {patience:.0f} seconds: start one with"
                f" `dask worker {address} --nthreads 1`"
            ) from error
        try:
            check_versions(client.run(versions))
        except ImportError as error:  # there, since all of it is here
            raise ValueError(
                f"a worker of {address} lacks a package ({error}): install the same environment.txt on all machines"
            ) from error
        # Dask's memory manager drops copies that no waiting task asks for, so between two generations those of V and M.
        managed = client.amm.running()
        client.amm.stop()
        try:
            yield ClusterExecutor(client, pure=False)
        finally:
            if managed:
                with suppress(
                    Exception
                ):  # whatever Dask raises if the scheduler, or by now the client, is lost
                    client.amm.start()


def check_address(address: str) -> None:
    """Raise ValueError unless a Client can try an address: given another, it leaves a process that hangs."""
    try:
        get_address_host_port(address)
        scheme = parse_address(address)[0]
    except ValueError:
        scheme = "unknown"
    try:
        certified = scheme == "tls" and Security().get_connection_args("client").get("ssl_context")
    except OSError as error:
        raise ValueError(
            f"scheduler {address!r}: Dask's certificates cannot be read ({error})"
        ) from error
    if scheme != "tcp" and not certified:
        raise ValueError(
            f"scheduler {address!r}: expected the address that it prints, such as tcp://10.0.0.1:8786 (one with tls://"
            " needs certificates in Dask's configuration)"
        )


def versions() -> dict[str, str]:
    """The versions on which the numbers depend, as they are in this process."""
    return {package: importlib.metadata.version(package) for package in SAME}


def check_versions(found: dict[str, dict[str, str]]) -> None:
    """Raise ValueError unless every worker, by its address, has the versions of this process."""
    for worker, theirs in found.items():
        for package, ours in versions().items():
            if theirs[package] != ours:
                raise ValueError(
                    f"worker {worker} has {package} {theirs[package]}, here it is {ours}: install the same"
                    " environment.txt on all machines"
                )
