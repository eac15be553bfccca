"""Where the work on tiles and views runs: in this process, in others of this machine, or on a Dask cluster.

A task is a function at the top of a module and an item; both go to the workers, and what they need beside
lies in files that all of them see. Its result is small; what is large it writes to a file of its own. A task
that is run twice writes the same, so a lost worker costs time only.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from sc3d.errors import InputError, Sc3dError
from sc3d.io.progress import progress
from sc3d.settings.common import Workers
from sc3d.tiling.worker_pool import RETRIES, WorkerPool

logger = logging.getLogger(__name__)


class Executor(Protocol):
    """Runs a function on items; the results come in the order of the items. needs: what a Dask worker must
    offer for one task, such as {"GPU": 1}
    """

    def run(
        self, name: str, function: Callable, items: Sequence, needs: dict[str, float] | None = None
    ) -> list: ...


class SerialExecutor:
    """One after another in this process."""

    def run(
        self, name: str, function: Callable, items: Sequence, needs: dict[str, float] | None = None
    ) -> list:
        return [function(item) for item in progress(items, name, "part")]


class LocalExecutor:
    """In processes of this machine. Which of them use its GPU, and how many it can feed, is for the user to
    say.
    """

    def __init__(self, pool: WorkerPool) -> None:
        self._pool = pool

    def run(
        self, name: str, function: Callable, items: Sequence, needs: dict[str, float] | None = None
    ) -> list:
        return self._pool.run(name, function, items)


class DaskExecutor:
    """On the workers of a Dask cluster."""

    def __init__(self, client: Any) -> None:
        self._client = client

    def run(
        self, name: str, function: Callable, items: Sequence, needs: dict[str, float] | None = None
    ) -> list:
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        if needs and not any(
            set(needs) <= set(worker["resources"])
            for worker in self._client.scheduler_info()["workers"].values()
        ):
            logger.warning(
                "%s: no worker offers %s; waiting for one",
                name,
                " ".join(f"{key}={value:g}" for key, value in needs.items()),
            )
        futures = self._client.map(function, list(items), pure=False, retries=RETRIES, resources=needs)
        try:
            for future in progress(as_completed(futures), name, "part", total=len(futures)):
                future.result()
            return [future.result() for future in futures]
        except KilledWorker as error:
            raise Sc3dError(f"{name}: {error}; give the workers more memory, or lower --max-memory") from None
        finally:
            self._client.cancel(futures)


@contextmanager
def open_executor(resources: Workers) -> Iterator[Executor]:
    """Here, or the workers that the options ask for. InputError if Dask is missing or the scheduler does not
    answer.
    """
    if resources.cluster:
        with _dask_client(resources.cluster) as client, client.as_current():
            yield DaskExecutor(client)
        return
    if resources.workers < 1:
        yield SerialExecutor()
        return
    pool = WorkerPool(resources.workers)
    try:
        yield LocalExecutor(pool)
    finally:
        pool.close()


def _dask_client(address: str) -> Any:
    """Certificates for tls:// addresses are found by Dask's own configuration."""
    try:
        from distributed import Client, Security
    except ImportError:
        raise InputError("--cluster needs Dask: pip install 'sc3d[cluster]'") from None
    logging.getLogger("distributed").setLevel(logging.WARNING)  # importing it sets INFO
    if address.startswith("tls://"):
        if not Security().get_connection_args("client").get("ssl_context"):
            raise InputError(
                f"{address} asks for a certificate: name yours in Dask's configuration, see the manual's page on several machines"
            )
    else:
        logger.warning(
            "%s is not encrypted: whoever reaches that port can run code on the cluster, as you; tls:// is safe",
            address,
        )
    try:
        return Client(address, timeout="20s", set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"no Dask scheduler answers at {address}: {error}") from None
