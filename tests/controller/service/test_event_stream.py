"""The stream of events: a follower gets a snapshot and then every event; one that falls behind, a new snapshot."""

from __future__ import annotations

import asyncio
import threading

from ringdic_controller.service.events import BACKLOG, EventStream


def test_a_follower_gets_the_snapshot_and_then_the_events_of_other_threads() -> None:
    async def story() -> list:
        stream = EventStream(lambda: {"nodes": 12})
        events = stream.follow()
        received = [await anext(events)]
        threading.Thread(target=lambda: [stream.publish("job", {"done": k}) for k in range(5)]).start()
        for _ in range(5):
            received.append(await asyncio.wait_for(anext(events), 5))
        await events.aclose()
        stream.publish("job", {"done": 9})  # nobody follows any more
        return received

    assert asyncio.run(story()) == [("snapshot", {"nodes": 12}), *(("job", {"done": k}) for k in range(5))]


def test_a_follower_far_behind_gets_a_snapshot_in_place_of_what_it_missed() -> None:
    async def story() -> list:
        state = {"count": 0}
        stream = EventStream(lambda: dict(state))
        events = stream.follow()
        await anext(events)
        for k in range(BACKLOG + 10):
            state["count"] = k
            stream.publish("tick", {"k": k})
        await asyncio.sleep(0)
        return [await asyncio.wait_for(anext(events), 5) for _ in range(3)]

    first, second, _ = asyncio.run(story())
    assert first == ("snapshot", {"count": BACKLOG + 9})
    assert second == ("tick", {"k": BACKLOG})


def test_publishing_after_the_loop_has_ended_is_harmless() -> None:
    stream = EventStream(dict)

    async def begin() -> object:
        events = stream.follow()
        await anext(events)
        return events

    events = asyncio.run(begin())  # held until the end, so that the follower is not removed
    stream.publish("job", {})
    assert events is not None


def test_an_event_that_happens_while_a_snapshot_is_taken_is_told_after_it() -> None:
    async def story() -> list:
        state = {"round": "open"}
        busy = False

        def snapshot() -> dict:
            copy = dict(state)
            if busy and state["round"] == "open":
                state["round"] = "closed"
                stream.publish("round", {"round": "closed"})
            return copy

        stream = EventStream(snapshot)
        events = stream.follow()
        await anext(events)
        busy = True
        stream.publish_snapshot()
        return [await asyncio.wait_for(anext(events), 5) for _ in range(2)]

    assert asyncio.run(story()) == [("snapshot", {"round": "open"}), ("round", {"round": "closed"})]
