"""Where the work on tiles and views runs: in this process, or on Dask workers.

A task is a function at the top of a module and an item; both go to the workers, and what they need beside
lies in files that all of them see. Its result is small; what is large it writes to a file of its own. A task
that is run twice writes the same, so a lost worker costs time only.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Protocol

from tqdm import tqdm

from sc3d.errors import InputError, Sc3dError
from sc3d.settings.common import Workers

logger = logging.getLogger(__name__)

RETRIES = 3  # of a task whose worker is lost; more, and the task itself is what kills it


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
        return [function(item) for item in tqdm(items, desc=name, disable=None)]


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
            for future in tqdm(as_completed(futures), desc=name, total=len(futures), disable=None):
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
    if not resources.cluster and resources.workers < 1:
        yield SerialExecutor()
        return
    try:
        from distributed import Client, LocalCluster
    except ModuleNotFoundError:
        raise InputError("--workers and --cluster need Dask: pip install 'sc3d[cluster]'") from None
    logging.getLogger("distributed").setLevel(logging.WARNING)  # importing it sets INFO
    if resources.cluster:
        try:
            client = Client(resources.cluster, timeout="20s", set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"no Dask scheduler answers at {resources.cluster}: {error}") from None
        with client, client.as_current():
            yield DaskExecutor(client)
        return
    threads = max(1, (os.cpu_count() or 1) // resources.workers)
    environment = {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
    cluster = partial(
        LocalCluster,
        n_workers=resources.workers,
        threads_per_worker=1,
        memory_limit=None,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        resources={"GPU": 1},
    )  # how many of them a GPU can feed is for the user to say
    before = {name: os.environ.get(name) for name in environment}
    os.environ.update(environment)
    try:
        with cluster() as local, Client(local, set_as_default=False) as client, client.as_current():
            yield DaskExecutor(client)
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
