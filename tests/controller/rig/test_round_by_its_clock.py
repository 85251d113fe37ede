"""A capture round waits by the monotonic clock, and tells the nodes their moment by what it knows of their clocks."""

from __future__ import annotations

import queue
from dataclasses import replace

import pytest
from ringdic.session.writer import Archive
from ringdic_controller.rig import capture as round_
from ringdic_controller.rig.capture import MS, SECOND, Timing
from ringdic_controller.rig.clocks import NodeTiming
from ringdic_controller.rig.rounds import CaptureRefusedError, run_round
from ringdic_node.wire import Arm, ArmReply, Inventory, Trigger, TriggerReply

TIMING = Timing(
    arm=2 * SECOND, arm_retry=SECOND // 2, lead=400 * MS, pull_after=SECOND, pull_every=SECOND, collect=5 * SECOND
)
HOUR = 3600 * SECOND
WALL = 1_800_000_000 * SECOND


class Clocks:
    """A monotonic clock that runs 50 ms each time it is read, and a wall clock beside it that may be set."""

    def __init__(self) -> None:
        self.now = 7 * SECOND
        self.set = 0

    def monotonic_ns(self) -> int:
        self.now += 50 * MS
        assert self.now < 60 * SECOND, "the round does not end"
        return self.now

    def wall_ns(self) -> int:
        return WALL + self.now + self.set


class Nodes:
    """Two nodes that arm and accept, and deliver nothing; what they were asked is kept."""

    def __init__(self, clocks: Clocks, events: queue.Queue) -> None:
        self.clocks, self.events = clocks, events
        self.error = {"a": MS // 10, "b": MS // 10}
        self.offset = {"a": 0, "b": 200 * MS}
        self.triggers: list[tuple[str, Trigger]] = []
        self.on_trigger = lambda: None

    def timing(self, camera: str, start_ns: int) -> NodeTiming | None:
        error = self.error[camera]
        return None if error is None else NodeTiming(start_ns - 11 * SECOND, self.offset[camera], error)

    def ask(self, camera, question, on_answer, timeout) -> None:
        if isinstance(question, Arm):
            on_answer(ArmReply(camera, True, question.settings_hash))
        elif isinstance(question, Trigger):
            self.triggers.append((camera, question))
            on_answer(TriggerReply(camera, question.key, "accepted"))
            self.on_trigger()
        else:
            on_answer(Inventory(camera, capturing=self.triggers[-1][1].key))

    def fetch(self, manifest) -> None: ...


@pytest.fixture
def clocks() -> Clocks:
    return Clocks()


@pytest.fixture
def nodes(clocks) -> Nodes:
    return Nodes(clocks, queue.Queue())


@pytest.fixture
def run(nodes, clocks, tmp_path, rig_toml, monkeypatch):
    monkeypatch.setattr("ringdic_controller.rig.rounds.HEARTBEAT", 0.0)
    session = Archive(tmp_path).create_session("s", rig_toml("ring", ["a", "b"]))

    def call(**changes):
        return run_round(
            nodes, nodes.events, session, "static",
            **{
                "cameras": ["a", "b"], "absent": [], "doubled": {}, "timing": TIMING, "tolerance_ns": MS,
                "override": False, "settings": {}, "on_event": lambda event: None, "wall_ns": clocks.wall_ns,
                "monotonic_ns": clocks.monotonic_ns, **changes,
            },
        )  # fmt: skip

    return call


@pytest.mark.parametrize("set_by", [-HOUR, HOUR])
def test_a_round_closes_in_its_time_whatever_the_wall_clock_is_set_to(run, nodes, clocks, set_by):
    def set_clock() -> None:
        clocks.set = set_by

    nodes.on_trigger = set_clock
    record = run()
    assert record.state == "closed"
    assert 5 * SECOND < clocks.now - 7 * SECOND < 8 * SECOND, "the wait for images lasted as long as planned"
    assert {entry.reason for entry in record.cameras.values()} == {"no image arrived within 5 s of the planned moment"}


def test_each_node_is_told_its_own_clock(run, nodes):
    record = run()
    told = dict(nodes.triggers)
    assert {trigger.key.fire_at_ns for trigger in told.values()} == {record.fire_at_ns}
    assert (told["a"].clock_offset_ns, told["b"].clock_offset_ns) == (0, 200 * MS)
    assert told["b"].clock_zero_ns == pytest.approx(WALL - 11 * SECOND, abs=200 * MS)
    assert told["b"].clock_error_ns == MS // 10


def test_the_offset_of_the_arming_is_told_although_the_clock_was_set_since(run, nodes):
    nodes.on_trigger = lambda: nodes.offset.update(b=500 * MS)
    run()
    assert {trigger.clock_offset_ns for camera, trigger in nodes.triggers if camera == "b"} == {200 * MS}


@pytest.mark.parametrize(("error", "told"), [(3 * MS, "±3.0 ms"), (None, "could not be measured")])
def test_a_clock_that_is_not_known_well_enough_is_not_armed(run, nodes, error, told):
    nodes.error["b"] = error
    with pytest.raises(CaptureRefusedError, match="b: not armed: its clock") as caught:
        run()
    assert told in caught.value.reasons["b"]
    assert list(caught.value.reasons) == ["b"]
    assert run(override=True).cameras["b"].status == "failed"


def test_a_clock_that_becomes_known_before_the_deadline_is_armed(run, nodes, clocks):
    nodes.error["b"] = None
    timing = nodes.timing

    def better_later(camera, start_ns):
        if clocks.now > 8 * SECOND:
            nodes.error["b"] = MS // 10
        return timing(camera, start_ns)

    nodes.timing = better_later
    assert run().state == "closed"


def test_a_trigger_that_a_node_refuses_fails_with_its_sentence():
    machine = round_.CaptureRound(["a"], replace(TIMING), 0)
    machine.handle(round_.ArmAnswered(ArmReply("a", True, "0" * 64)), 0)
    key = round_.CaptureKey("s", "0001-board", SECOND)
    machine.handle(round_.CaptureOpened(key), 0)
    for verdict in ("refused", "missed"):
        machine.handle(round_.TriggerAnswered(TriggerReply("a", key, verdict, f"{verdict}, in words")), 0)
        assert machine.outcomes["a"].reason == f"{verdict}, in words"
