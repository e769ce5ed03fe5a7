"""The workers of a Dask cluster in place of this machine's own processes.

Episodes depend on their seeds alone, so a cluster only changes how long a run takes; on other
processors the last bits may differ.
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

PATIENCE = 60.0  # seconds to wait for a scheduler to answer, and for its first worker
SAME = (
    "stad_lab", "torch", "numpy", "numba", "gymnasium", "box2d", "pygame-ce",
    "opencv-python-headless",
)  # fmt: skip
REMEDY = "install the same environment.txt on all machines"


class ClusterExecutor(ClientExecutor):
    """Dask's executor, which repeats the work of a lost worker, with a way to share V and M."""

    def share(self, value: Any) -> Future:
        """A stand-in for `value` in the arguments of tasks: every worker receives it once.

        It is the result of a task, so Dask computes it again if the workers that held it are lost.
        All workers fetch it now, because Dask prefers to send a task to where its arguments are.
        Raises as `run_tasks`.
        """
        once = {"allow_other_workers": True, "pure": False}
        with warnings.catch_warnings(), task_errors("share"):
            warnings.filterwarnings("ignore", "Sending large graph")
            shared = self._client.submit(lambda: value, pure=False)  # it is pickled with its value
            workers = self._client.nthreads()
            for done in [self._client.submit(id, shared, workers=[w], **once) for w in workers]:
                done.result()
        return shared


@contextmanager
def cluster(address: str, patience: float = PATIENCE) -> Iterator[ClusterExecutor]:
    """The workers of the Dask scheduler at `address`, as an executor, for a `with` block.

    Args:
        address: as `dask scheduler` prints it, for example "tcp://10.0.0.1:8786".
        patience: seconds to wait for it, and for a worker.

    Raises:
        OSError: no scheduler answers, or it has no worker.
        ValueError: this is no address, or a worker lacks a package or has another version of it.
    """
    check_address(address)
    try:
        client = Client(address, timeout=patience, set_as_default=False)
    except OSError as error:
        message = "start one with `dask scheduler`, and give the address that it prints"
        raise OSError(f"no Dask scheduler answers at {address!r} ({error}): {message}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=patience)
        except TimeoutError as error:
            remedy = f"start one with `dask worker {address} --nthreads 1`"
            raise OSError(f"{address} has no worker after {patience:.0f} s: {remedy}") from error
        try:
            check_versions(client.run(versions))
        except ImportError as error:
            raise ValueError(f"worker of {address} lacks a package ({error}): {REMEDY}") from error
        # Dask's memory manager drops copies that no waiting task needs: V and M, between two calls.
        managed = client.amm.running()
        client.amm.stop()
        try:
            yield ClusterExecutor(client, pure=False)
        finally:
            with suppress(Exception):  # Dask raises many errors if the scheduler is lost
                if managed:
                    client.amm.start()


def check_address(address: str) -> None:
    """Raise ValueError unless it is an address for Client, which hangs if given another."""
    try:
        if not 0 < (port := get_address_host_port(address)[1]) < 2**16:
            raise ValueError(f"there is no port {port}")
        scheme = parse_address(address)[0]
        secure = scheme == "tls" and Security().get_connection_args("client").get("ssl_context")
    except (ValueError, OSError) as error:
        scheme, secure = f"an error: {error}", None
    if scheme != "tcp" and not secure:
        raise ValueError(
            f"scheduler {address!r} ({scheme}): expected the address that it prints, such as"
            " tcp://10.0.0.1:8786; tls:// needs certificates in Dask's configuration"
        )


def versions() -> dict[str, str]:
    """The versions of this process on which the numbers depend."""
    return {package: importlib.metadata.version(package) for package in SAME}


def check_versions(found: dict[str, dict[str, str]]) -> None:
    """Raise ValueError unless every worker, by its address, has the versions of this process."""
    for worker, theirs in found.items():
        for package, ours in versions().items():
            if theirs[package] != ours:
                both = f"{package} {theirs[package]}, here it is {ours}"
                raise ValueError(f"worker {worker} has {both}: {REMEDY}")
