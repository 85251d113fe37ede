"""The driver's side of a cluster: gives tasks to the scheduler as they may start, takes how they ended."""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ringdic.errors import ComputationError, InputError
from ringdic.jobs.cluster.worker import VISIBLE_S, Sign, TaskOutcome, inspect, run_task, visible
from ringdic.tasks import Agenda, Task, Told, code_stamp

log = logging.getLogger(__name__)

_RETRIES = 2  # of a task that failed for a reason of the machine, such as a shared folder that did not answer
_LOOK_S = 2.0  # between two looks at the cluster while no task ends
_INSPECTION_S = 600.0  # a worker may have to compile the kernels first


class ClusterExecutor:
    """Runs tasks on the workers of a dask scheduler. A worker runs as many at a time as it has threads.

    address : of the scheduler, like ``tcp://192.168.1.10:8786``. answer_s : within which the scheduler must answer.
    idle_s : that a job waits without any worker. Raises InputError if dask is not installed.
    """

    def __init__(self, address: str, *, answer_s: float = 10.0, idle_s: float = 60.0) -> None:
        _distributed()
        self.address = address
        self._answer_s = answer_s
        self._idle_s = idle_s

    def check(self, folder: Path) -> None:
        """Ask every worker whether it is fit to work in this folder, which exists, and have it load its kernels.

        Raises InputError where the scheduler does not answer, there is no worker, or one does not see the folder or
        runs another version of this program.
        """
        with self._connected() as client, _sign(folder) as sign:
            workers = list(client.nthreads())
            if not workers:
                raise InputError(
                    f"the cluster {self.address} has no worker; "
                    f"start one on each machine with 'dask worker {self.address}'"
                )
            asked = {
                worker: client.submit(inspect, sign, workers=[worker], allow_other_workers=False, pure=False)
                for worker in workers
            }
            _wait(list(asked.values()), _INSPECTION_S, "ALL_COMPLETED")
            for worker, future in asked.items():
                if future.status == "error":
                    raise InputError(f"worker {worker} does not run ringdic ({future.exception()}); install it there")
                reason = future.result() if future.status == "finished" else None  # one busy with other jobs is let be
                if reason is not None:
                    raise InputError(f"worker {worker} cannot be used: {reason}")

    def run(self, tasks: Sequence[Task], told: Told) -> None:
        """See ``Executor.run``. A worker that is not fit is left out.

        Raises InputError where the scheduler does not answer or no worker is fit, ComputationError if the cluster is
        lost meanwhile.
        """
        agenda = Agenda(tasks, told)
        if not agenda:
            return
        tasks[0].folder.mkdir(exist_ok=True)
        with self._connected() as client, _sign(tasks[0].folder) as sign:
            try:
                _Job(client, sign, agenda, self._idle_s).run()
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
    """The tasks of one run on their way through the cluster."""

    def __init__(self, client: Any, sign: Sign, agenda: Agenda, idle_s: float) -> None:
        self._client = client
        self._sign = sign
        self._agenda = agenda
        self._idle_s = idle_s
        self._running: dict[Any, Task] = {}
        self._unfit: set[str] = set()
        self._submitted = 0
        self._seen_at = time.monotonic()  # when there was a worker

    def run(self) -> None:
        """Submit what may start, take what has ended, until nothing is left."""
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
        """The threads of every worker that may be of use."""
        threads = {
            worker: count for worker, count in self._client.nthreads().items() if worker not in self._unfit
        }  # fmt: skip
        now = time.monotonic()
        if threads:
            self._seen_at = now
        elif now - self._seen_at > self._idle_s:
            raise ComputationError(
                f"the cluster has had no worker for {self._idle_s:.0f} s; start one and process again: "
                "what is done is kept"
            )
        return threads

    def _submit(self, task: Task, threads: dict[str, int], share: int = 1) -> None:
        future = self._client.submit(
            run_task,
            task,
            self._sign,
            share,
            key=f"{task.function.__name__}-{uuid.uuid4().hex}",  # of this run: another's may be cancelled with it
            retries=_RETRIES,
            workers=list(threads) if self._unfit else None,
            priority=-self._submitted,  # in order: neighbours read the same images
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
        if outcome.wrong is not None:
            raise InputError(outcome.wrong)
        if outcome.ran is None:
            self._shun(outcome, threads)
            self._submit(task, threads)
        elif visible(lambda: task.done, task.folder):
            self._agenda.ended(task, outcome.ran)
        else:
            raise InputError(
                f"{task.output}: written by worker {outcome.worker} and not seen here after {VISIBLE_S:.0f} s; "
                "every machine must see the session's folder under the same path"
            )

    def _shun(self, outcome: TaskOutcome, threads: dict[str, int]) -> None:
        """Give a worker of no use nothing more to do."""
        threads.pop(outcome.worker, None)
        if not threads:
            raise InputError(f"worker {outcome.worker} cannot be used, and there is no other: {outcome.unfit}")
        if outcome.worker not in self._unfit:
            log.warning("worker %s is left out: %s", outcome.worker, outcome.unfit)
            self._unfit.add(outcome.worker)


def _distributed() -> Any:
    """The library, or a sentence about how to get it."""
    try:
        import distributed
    except ImportError as error:
        raise InputError(
            f"a cluster needs a library that is not installed ({error}); "
            "install the extra: pip install 'ringdic[cluster]'"
        ) from error
    for name in ("distributed", "distributed.client"):  # a lost scheduler is told in a sentence, not in tracebacks
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return distributed


def _wait(futures: list[Any], timeout: float, until: str) -> list[Any]:
    """The futures that have ended; waits no longer than ``timeout`` seconds."""
    try:
        return list(_distributed().wait(futures, timeout=timeout, return_when=until).done)
    except TimeoutError:
        return [future for future in futures if future.done()]


@contextmanager
def _sign(folder: Path) -> Iterator[Sign]:
    """A file in the folder by which a worker knows that it sees the same one."""
    file = folder / f".cluster-{uuid.uuid4().hex}"
    text = uuid.uuid4().hex
    file.write_text(text, encoding="utf-8")
    try:
        yield Sign(code_stamp(), file, text)
    finally:
        file.unlink(missing_ok=True)
