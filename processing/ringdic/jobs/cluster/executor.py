"""The driver's side of a cluster: submits tasks to the scheduler once they may start, and collects their outcomes."""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ringdic.compiled import source_digest
from ringdic.errors import ComputationError, InputError
from ringdic.jobs.cluster.worker import VISIBLE_S, Handshake, TaskOutcome, inspect, run_task, visible
from ringdic.tasks import Agenda, OnTaskEnd, Task

log = logging.getLogger(__name__)

_RETRIES = 2  # of a task that failed because of the machine, for instance of a shared folder that did not answer
_LOOK_S = 2.0  # time between two checks of the workers while no task ends
_INSPECTION_S = 600.0  # a worker may have to compile the kernels first


class ClusterExecutor:
    """Runs tasks on the workers of a dask scheduler. A worker runs as many tasks at a time as it has threads.

    address : of the scheduler, such as ``tcp://192.168.1.10:8786``. answer_s : time limit of the scheduler's answer, s.
    idle_s : time limit of waiting while there is no worker, s. Raises InputError where dask is not installed.
    """

    def __init__(self, address: str, *, answer_s: float = 10.0, idle_s: float = 60.0) -> None:
        _distributed()
        self.address = address
        self._answer_s = answer_s
        self._idle_s = idle_s

    def check(self, folder: Path) -> None:
        """Check that every worker can run tasks in an existing folder, and have each load its kernels.

        Raises InputError where the scheduler does not answer, there is no worker, or one does not see the folder or
        runs another version of this program.
        """
        with self._connected() as client, _handshake(folder) as handshake:
            workers = list(client.nthreads())
            if not workers:
                raise InputError(
                    f"the cluster {self.address} has no worker; "
                    f"start one on each machine with 'dask worker {self.address}'"
                )
            asked = {
                worker: client.submit(inspect, handshake, workers=[worker], allow_other_workers=False, pure=False)
                for worker in workers
            }
            _wait(list(asked.values()), _INSPECTION_S, "ALL_COMPLETED")
            for worker, future in asked.items():
                if future.status == "error":
                    raise InputError(f"worker {worker} does not run ringdic ({future.exception()}); install it there")
                # A worker that is busy with other jobs has not finished and is not refused.
                reason = future.result() if future.status == "finished" else None
                if reason is not None:
                    raise InputError(f"worker {worker} cannot be used: {reason}")

    def run(self, tasks: Sequence[Task], on_end: OnTaskEnd) -> None:
        """Run every task that is not done on the workers; a worker that fails the check gets no tasks.

        tasks : in an order in which each follows the tasks that it needs. on_end : called in the calling thread, once
        for each task.
        Raises InputError where the scheduler does not answer or no worker passes the check, ComputationError where the
        cluster is lost meanwhile.
        """
        agenda = Agenda(tasks, on_end)
        if not agenda:
            return
        tasks[0].folder.mkdir(exist_ok=True)
        with self._connected() as client, _handshake(tasks[0].folder) as handshake:
            try:
                _Job(client, handshake, agenda, self._idle_s).run()
            except (OSError, _distributed().CancelledError) as error:
                raise ComputationError(
                    f"the scheduler {self.address} was lost; start it again and process again: what is done is kept"
                ) from error

    @contextmanager
    def _connected(self) -> Iterator[Any]:
        """A client of the scheduler."""
        try:
            _distributed().comm.resolve_address(self.address)
            client = _distributed().Client(self.address, timeout=self._answer_s, set_as_default=False)
        except ValueError as error:
            raise InputError(
                f"--cluster {self.address}: no address of a scheduler; write it like tcp://192.168.1.10:8786"
            ) from error
        except OSError as error:
            raise InputError(
                f"no scheduler answers at {self.address} within {self._answer_s:g} s; start one with "
                "'dask scheduler', or check the address"
            ) from error
        try:
            with client.as_current():
                yield client
        finally:
            client.close(timeout=self._answer_s)


class _Job:
    """The tasks of one run on a cluster: which are running, and on which workers."""

    def __init__(self, client: Any, handshake: Handshake, agenda: Agenda, idle_s: float) -> None:
        self._client = client
        self._handshake = handshake
        self._agenda = agenda
        self._idle_s = idle_s
        self._running: dict[Any, Task] = {}
        self._refused: set[str] = set()
        self._submitted = 0
        self._worker_at = time.monotonic()  # last time that there was a worker

    def run(self) -> None:
        """Submit the tasks that may start and take the outcomes of those that have ended, until none is left."""
        try:
            while self._agenda:
                threads = self._workers()
                share = max(1, sum(threads.values()) // max(1, len(self._running) + self._agenda.ready))
                while (task := self._agenda.start()) is not None:
                    self._submit(task, threads, share)
                for future in _wait(list(self._running), _LOOK_S, "FIRST_COMPLETED"):
                    self._take(self._running.pop(future), future, threads)
        finally:
            self._client.cancel(list(self._running))

    def _workers(self) -> dict[str, int]:
        """Number of threads of each worker that has not been refused, by its address."""
        threads = {
            worker: count for worker, count in self._client.nthreads().items() if worker not in self._refused
        }  # fmt: skip
        now = time.monotonic()
        if threads:
            self._worker_at = now
        elif now - self._worker_at > self._idle_s:
            raise ComputationError(
                f"the cluster has had no worker for {self._idle_s:.0f} s; start one and process again: "
                "what is done is kept"
            )
        return threads

    def _submit(self, task: Task, threads: dict[str, int], share: int = 1) -> None:
        future = self._client.submit(
            run_task,
            task,
            self._handshake,
            share,
            # Unique to this run, since cancelling a key cancels it for every client.
            key=f"{task.function.__name__}-{uuid.uuid4().hex}",
            retries=_RETRIES,
            workers=list(threads) if self._refused else None,
            priority=-self._submitted,  # in order, since neighbours read the same images
        )
        self._submitted += 1
        self._running[future] = task

    def _take(self, task: Task, future: Any, threads: dict[str, int]) -> None:
        try:
            outcome: TaskOutcome = future.result()
        except _distributed().KilledWorker as error:
            raise ComputationError(
                f"{task.name}: one worker after the other died at it; their logs tell why (out of memory?)"
            ) from error
        if outcome.input_error is not None:
            raise InputError(outcome.input_error)
        if outcome.report is None:
            self._refuse(outcome, threads)
            self._submit(task, threads)
        elif visible(lambda: task.done, task.folder):
            self._agenda.ended(task, outcome.report)
        else:
            raise InputError(
                f"{task.output}: written by worker {outcome.worker} and not seen here after {VISIBLE_S:.0f} s; "
                "every machine must see the session's folder under the same path"
            )

    def _refuse(self, outcome: TaskOutcome, threads: dict[str, int]) -> None:
        """Submit no more tasks to a worker that refused one; raises InputError where no other is left."""
        threads.pop(outcome.worker, None)
        if not threads:
            raise InputError(f"worker {outcome.worker} cannot be used, and there is no other: {outcome.refusal}")
        if outcome.worker not in self._refused:
            log.warning("worker %s is left out: %s", outcome.worker, outcome.refusal)
            self._refused.add(outcome.worker)


def _distributed() -> Any:
    """The dask.distributed module; raises InputError with the way to install it where it is missing."""
    try:
        import distributed
    except ImportError as error:
        raise InputError(
            f"a cluster needs a library that is not installed ({error}); "
            "install the extra: pip install 'ringdic[cluster]'"
        ) from error
    for name in ("distributed", "distributed.client"):  # their tracebacks; a lost scheduler is reported in a sentence
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return distributed


def _wait(futures: list[Any], timeout: float, until: str) -> list[Any]:
    """Wait for at most ``timeout`` seconds until a future has ended; returns the futures that have ended."""
    try:
        return list(_distributed().wait(futures, timeout=timeout, return_when=until).done)
    except TimeoutError:
        return [future for future in futures if future.done()]


@contextmanager
def _handshake(folder: Path) -> Iterator[Handshake]:
    """A handshake with a file in this folder, which is removed after the context."""
    file = folder / f".cluster-{uuid.uuid4().hex}"
    text = uuid.uuid4().hex
    file.write_text(text, encoding="utf-8")
    try:
        yield Handshake(source_digest(), file, text)
    finally:
        file.unlink(missing_ok=True)
