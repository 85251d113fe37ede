"""Sequences of captures: each round at its own time, whatever became of the one before; one at a time; cancellable."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ringdic_controller.service.desk import Desk
from ringdic_controller.service.sequences import CaptureSequence, Sequences, Timetable

API = "/api/v1"


def until(condition: Callable[[], Any], timeout: float = 20.0) -> Any:
    """The condition's value once it holds."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(0.01)
    raise TimeoutError("it never came about")


class TurnedClock:
    """A clock that a wait turns to its end at once, and that a round turns on by as many seconds as it takes."""

    def __init__(self, durations: list[float]) -> None:
        self.now = 1000.0
        self.durations = durations
        self.began: list[float] = []

    def __call__(self) -> float:
        return self.now

    def wait(self, event: threading.Event, seconds: float) -> bool:
        self.now += seconds
        return event.is_set()


@pytest.fixture
def timed(desk: Desk, nodes) -> Callable[..., tuple[CaptureSequence, TurnedClock, list[CaptureSequence]]]:
    """Call it with the rounds' durations and the time between them: the ended sequence, its clock, its states."""
    desk.create_session("limb")

    def run(durations: list[float], count: int, every_s: float, refused: tuple[int, ...] = ()):
        clock, states = TurnedClock(durations), []
        capture = nodes.capture

        def slow(*arguments: Any, **more: Any) -> Any:
            clock.began.append(clock.now - 1000.0)
            nodes.unarmed = "03" if len(clock.began) in refused else None
            record = capture(*arguments, **more)
            clock.now += clock.durations[len(clock.began) - 1]
            return record

        nodes.capture = slow
        sequences = Sequences(desk.rounds, states.append, clock, clock.wait)
        begun = sequences.begin("board", count, every_s)
        until(lambda: states and states[-1].state != "running")
        return sequences.get(begun.id), clock, states

    return run


@given(st.floats(0.01, 1e4), st.integers(1, 500), st.integers(0, 500), st.floats(0, 1e6))
def test_the_next_round_is_the_first_whose_time_is_not_over(every: float, count: int, number: int, late: float) -> None:
    table = Timetable(50.0, every, count)
    following = table.next_round(min(number, count), 50.0 + late)
    assert min(number, count) <= following <= count
    if following < count:
        assert table.due(following + 1) >= 50.0 + late - 1e-6 * (1 + late)
    if following > number:  # those that were passed over could not begin any more
        assert table.due(following) <= 50.0 + late + 1e-6 * (1 + late)


def test_a_late_round_shifts_no_other_and_those_that_cannot_begin_are_named(timed) -> None:
    # Round 2 ends in the time of 3, which begins late; round 4 ends in the time of 6, so that 5 never had one.
    ended, clock, states = timed([1.0, 13.0, 1.0, 25.0, 1.0, 1.0], count=7, every_s=10.0)
    assert clock.began == [0.0, 10.0, 23.0, 30.0, 55.0, 60.0]
    assert ended.captures == tuple(f"000{number}-board" for number in range(1, 7))
    assert [each.number for each in ended.missed] == [5]
    assert "Round 5 was skipped: the one before it closed 15.0 s after" in ended.missed[0].reason
    assert (ended.state, {each.state for each in states[:-1]}) == ("ended", {"running"})


def test_a_burst_has_no_pause_and_skips_nothing(timed) -> None:
    ended, clock, _ = timed([0.5, 3.0, 0.25], count=3, every_s=0.0)
    assert clock.began == [0.0, 0.5, 3.5]
    assert (ended.state, ended.missed) == ("ended", ())
    assert ended.captures == ("0001-board", "0002-board", "0003-board")


def test_a_sequence_over_http_is_told_to_who_follows(client, desk) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    told: list[tuple[str, Any]] = []
    desk.state.events.publish = lambda name, payload: told.append((name, payload))
    answer = client.post(f"{API}/captures", json={"kind": "board", "count": 3, "every_s": 0.05})
    assert answer.status_code == 202
    begun = answer.json()
    assert (begun["id"], begun["count"], begun["every_s"], begun["session"]) == ("s1", 3, 0.05, "limb")
    until(lambda: client.get(f"{API}/sequences/s1").json()["state"] == "ended")
    ended = client.get(f"{API}/sequences/s1").json()
    assert len(ended["captures"]) + len(ended["missed"]) == 3
    assert [record["capture_id"] for record in client.get(f"{API}/sessions/limb/captures").json()] == ended["captures"]
    until(lambda: ("sequence", "ended") in [(name, each.get("state")) for name, each in told])
    assert {each["sequence"] for name, each in told if name == "round"} == {"s1"}
    until(lambda: client.get(f"{API}/rig").json()["refusal"] is None)
    assert desk.state.snapshot()["sequence"]["captures"] == tuple(ended["captures"])


def test_meanwhile_nothing_else_is_captured_and_a_cancelled_one_ends_after_its_round(client, nodes) -> None:
    for name in ("other", "limb"):
        client.post(f"{API}/sessions", json={"name": name})
    nodes.gate.clear()
    body = {"kind": "board", "count": 5, "every_s": 0}
    first = client.post(f"{API}/captures", json=body).json()
    until(lambda: client.get(f"{API}/sessions/limb/captures").json())
    for refused in (
        client.post(f"{API}/captures", json=body),
        client.post(f"{API}/captures", json={"kind": "board"}),
        client.put(f"{API}/sessions/current", json={"name": "other"}),
    ):
        assert refused.status_code == 409
        assert "under way" in refused.json()["detail"]
    assert client.post(f"{API}/sequences/{first['id']}/cancel").json()["state"] == "running"
    nodes.gate.set()
    until(lambda: client.get(f"{API}/sequences/s1").json()["state"] == "cancelled")
    assert client.get(f"{API}/sequences/s1").json()["captures"] == ["0001-board"]
    assert client.post(f"{API}/sequences/s1/cancel").json()["state"] == "cancelled"
    assert client.post(f"{API}/captures", json={"kind": "board"}).status_code == 202


def test_between_two_rounds_a_sequence_is_cancelled_at_once_and_lets_nothing_in(client, desk) -> None:
    for name in ("other", "limb"):
        client.post(f"{API}/sessions", json={"name": name})
    client.post(f"{API}/captures", json={"kind": "board", "count": 2, "every_s": 3600})
    until(lambda: client.get(f"{API}/sequences/s1").json()["captures"])
    for refused in (
        client.post(f"{API}/captures", json={"kind": "board"}),
        client.post(f"{API}/captures", json={"kind": "board", "count": 1}),
        client.put(f"{API}/sessions/current", json={"name": "other"}),
        client.post(f"{API}/sessions", json={"name": "third"}),
    ):
        assert (refused.status_code, "sequence" in refused.json()["detail"]) == (409, True)
    client.post(f"{API}/sequences/s1/cancel")
    until(lambda: client.get(f"{API}/sequences/s1").json()["state"] == "cancelled")
    assert client.put(f"{API}/sessions/current", json={"name": "other"}).status_code == 200


def test_a_sequence_is_refused_while_a_capture_is_under_way(client, nodes) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    nodes.gate.clear()
    client.post(f"{API}/captures", json={"kind": "board"})
    refused = client.post(f"{API}/captures", json={"kind": "board", "count": 2})
    assert (refused.status_code, "capture is under way" in refused.json()["detail"]) == (409, True)
    assert client.get(f"{API}/sequences/s1").status_code == 404
    nodes.gate.set()


@pytest.mark.parametrize(("every_s", "captures"), [(10.0, 2), (0.0, 1)])
def test_a_round_that_is_refused_is_named_and_the_next_is_taken_but_a_burst_ends(
    timed, every_s: float, captures: int
) -> None:
    ended, clock, _ = timed([1.0, 0.0, 1.0], count=3, every_s=every_s, refused=(2,))
    assert [each.number for each in ended.missed] == [2]
    assert "camera 03 is not armed" in ended.missed[0].reason
    assert (ended.state, len(ended.captures), len(clock.began)) == ("ended", captures, captures + 1)


@pytest.mark.parametrize(
    "body", [{"count": 0}, {"count": 10_001}, {"every_s": 1}, {"count": 2, "every_s": -1}, {"count": 2, "every_s": 1e9}]
)
def test_numbers_that_make_no_sequence_are_refused(client, body: dict[str, Any]) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    assert client.post(f"{API}/captures", json={"kind": "board", **body}).status_code == 422
    assert client.get(f"{API}/sessions/limb/captures").json() == []
