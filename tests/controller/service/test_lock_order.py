"""No two locks of the controller are ever taken in both orders: its threads cannot wait for each other for ever."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from fastapi.testclient import TestClient
from ringdic_controller.archive import catalogue
from ringdic_controller.jobs import children, jobs
from ringdic_controller.jobs.children import WarmChild
from ringdic_controller.service import events, live_state, rounds, sequences, sessions
from ringdic_controller.service.app import create_app
from ringdic_controller.service.desk import Desk

API = "/api/v1"
OUTER = "live_state"  # the one lock with which others may be taken


class LockRecord:
    """Which locks threads took while they held which others, by the name of the module that the locks are in."""

    def __init__(self) -> None:
        self.taken: set[str] = set()
        self.pairs: set[tuple[str, str]] = set()
        self._held = threading.local()

    def held(self) -> list[WatchedLock]:
        """The locks that this thread holds, in the order in which it took them."""
        if not hasattr(self._held, "locks"):
            self._held.locks = []
        return self._held.locks


class WatchedLock:
    """A lock that notes what its thread holds already when it is taken."""

    def __init__(self, lock: Any, name: str, record: LockRecord) -> None:
        self._lock, self._name, self._record = lock, name, record

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        held = self._record.held()
        if self not in held:  # else it is re-entered, which waits for nobody
            self._record.taken.add(self._name)
            self._record.pairs |= {(outer._name, self._name) for outer in held}
        acquired = self._lock.acquire(blocking, timeout)
        if acquired:
            held.append(self)
        return acquired

    def release(self) -> None:
        self._record.held().remove(self)
        self._lock.release()

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()

    def _is_owned(self) -> bool:  # asked by threading.Condition
        return self in self._record.held()


@pytest.fixture
def record(monkeypatch: pytest.MonkeyPatch) -> LockRecord:
    """Record of the locks of all objects that are made after it."""
    record = LockRecord()

    def watched(make: Callable[[], Any], name: str) -> Callable[[], WatchedLock]:
        return lambda: WatchedLock(make(), name, record)

    for module in (children, events, live_state, rounds, sequences, sessions):
        monkeypatch.setattr(module, "Lock", watched(threading.Lock, module.__name__.rsplit(".", 1)[1]))
    monkeypatch.setattr(catalogue, "RLock", watched(threading.RLock, "catalogue"))
    monkeypatch.setattr(jobs, "Condition", lambda: threading.Condition(WatchedLock(threading.Lock(), "jobs", record)))
    return record


@contextmanager
def readers(client: TestClient, number: int = 3) -> Iterator[None]:
    """Threads that ask for everything over and over."""
    ended = threading.Event()

    def read() -> None:
        while not ended.wait(0.01):
            for path in ("rig", "sessions", "jobs", "sessions/limb/live", "sessions/limb/results"):
                client.get(f"{API}/{path}")

    threads = [threading.Thread(target=read) for _ in range(number)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join(20)


def until(condition: Callable[[], Any]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline, "it never came about"
        time.sleep(0.02)


def test_a_session_takes_locks_in_one_order_only(
    record: LockRecord, desk_of: Callable[..., Desk], warm_stand_in: WarmChild
) -> None:
    desk = desk_of(warm_stand_in, quiet=0.3, watch=0.05)
    with TestClient(create_app(desk), base_url="http://127.0.0.1") as client, readers(client):
        client.post(f"{API}/sessions", json={"name": "limb"})
        for kind in ("board", "target", "specimen", "specimen", "specimen"):
            begun = client.post(f"{API}/captures", json={"kind": kind}).json()["id"]
            until(lambda: desk.rounds.get(begun).ended)  # noqa: B023
        client.post(f"{API}/captures", json={"kind": "target", "count": 2})
        until(lambda: desk.sequences.get("s1").state == "ended")
        until(lambda: desk.catalogue.runs("limb"))
        client.post(f"{API}/jobs/{client.post(f'{API}/jobs', json={'session': 'limb'}).json()['id']}/cancel")
        client.put(f"{API}/sessions/current", json={"name": "limb"})
        until(lambda: all(job.finished for job in desk.jobs.list()))
    desk.close()
    parts = {"catalogue", "children", "events", "jobs", "live_state", "rounds", "sequences", "sessions"}
    assert record.taken == parts, "every part's lock was taken"
    below = {(OUTER, part) for part in ("catalogue", "events", "rounds", "sequences", "sessions")}
    assert record.pairs >= below, "a state is read and published with the outer lock held"
    assert {outer for outer, _ in record.pairs} == {OUTER}, "with any other lock held, none is taken"
    assert OUTER not in {inner for _, inner in record.pairs}, "the outer lock is taken by threads that hold none"


def test_locks_taken_in_both_orders_are_noticed(record: LockRecord) -> None:
    first, second = WatchedLock(threading.Lock(), "a", record), WatchedLock(threading.Lock(), "b", record)
    with first, second:
        pass
    with second, first:
        pass
    assert record.pairs == {("a", "b"), ("b", "a")}
