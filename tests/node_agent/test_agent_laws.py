"""The node's state machine, law by law."""

from __future__ import annotations

from dataclasses import replace

import pytest
from ringdic_node.agent import (
    CAPTURE_LIMIT_NS,
    FURTHEST_NS,
    LOCK_LIMIT_NS,
    Acknowledged,
    Agent,
    AgentTick,
    Answer,
    AnswerImage,
    ArmAsked,
    CameraLocked,
    CameraRefused,
    Decline,
    DeliveredRemoved,
    FetchAsked,
    FrameLost,
    FrameSpooled,
    Free,
    InventoryAsked,
    LockCamera,
    Publish,
    Report,
    Sent,
    TakeFrame,
    Triggered,
)
from ringdic_node.clock import Instant
from ringdic_node.wire import Ack, Arm, ArmReply, CaptureKey, Manifest, Trigger

SECOND = 1_000_000_000
NOW = Instant(100 * SECOND, 0)
KEY = CaptureKey("s", "0001-board", 101 * SECOND)
ONE, TWO = "1" * 64, "2" * 64
MANIFEST = Manifest("n", KEY, "board", ONE, bytes=9, width=3, height=3, time_ns=101 * SECOND)


def at(seconds: float) -> Instant:
    """So long after NOW."""
    return Instant(NOW.wall_ns + round(seconds * SECOND), round(seconds * SECOND))


def arm(hash_: str = ONE, question: int = 1) -> ArmAsked:
    return ArmAsked(Arm("s", "board", {"exposure_us": 5}, hash_, ("n",)), question)


def armed_agent() -> Agent:
    agent = Agent("n", NOW)
    agent.handle(arm(), NOW)
    agent.handle(CameraLocked(ArmReply("n", True, ONE)), NOW)
    return agent


def trigger(question: int = 7) -> Triggered:
    return Triggered(Trigger(KEY, "board"), question)


def capturing_agent() -> Agent:
    agent = armed_agent()
    agent.handle(trigger(), NOW)
    return agent


def test_arming_locks_the_camera_once_and_answers_everyone_who_asked():
    agent = Agent("n", NOW)
    assert agent.handle(arm(question=1), NOW) == [LockCamera({"exposure_us": 5}, ONE)]
    assert agent.handle(arm(question=2), NOW) == []
    reply = ArmReply("n", True, ONE)
    assert agent.handle(CameraLocked(reply), NOW) == [Answer(1, reply), Answer(2, reply)]
    assert agent.state == "armed"
    assert agent.handle(arm(question=3), NOW) == [Answer(3, reply)]


def test_other_settings_lock_the_camera_anew():
    agent = armed_agent()
    assert agent.handle(arm(TWO, 4), NOW) == [LockCamera({"exposure_us": 5}, TWO)]
    assert not agent.armed


def test_a_camera_that_refuses_leaves_the_node_idle_with_the_reason():
    agent = Agent("n", NOW)
    agent.handle(arm(), NOW)
    (answer,) = agent.handle(CameraRefused(ONE, "no such gain"), NOW)
    assert answer.message.armed is False
    assert answer.message.reason == "no such gain"
    assert agent.state == "idle"


def test_a_repeated_trigger_takes_one_frame_and_gets_the_same_answer():
    agent = armed_agent()
    first = agent.handle(trigger(1), NOW)
    again = agent.handle(trigger(2), NOW)
    assert [type(a) for a in first] == [Answer, TakeFrame]
    assert [type(a) for a in again] == [Answer]
    assert again[0].message == first[0].message
    agent.handle(FrameSpooled(MANIFEST), NOW)
    (after,) = agent.handle(trigger(3), at(2))
    assert after.message.verdict == "accepted"


def test_an_unarmed_node_takes_nothing_but_may_still_be_armed_in_time():
    agent = Agent("n", NOW)
    (answer,) = agent.handle(trigger(), NOW)
    assert answer.message.verdict == "not armed"
    agent.handle(arm(), NOW)
    agent.handle(CameraLocked(ArmReply("n", True, ONE)), NOW)
    assert any(isinstance(a, TakeFrame) for a in agent.handle(trigger(), NOW))


def test_a_trigger_after_its_moment_is_missed_and_reported():
    agent = armed_agent()
    answer, report = agent.handle(trigger(), at(1.5))
    assert answer.message.verdict == "missed"
    assert "500.0 ms" in answer.message.reason
    assert isinstance(report, Report)
    assert report.failure.key == KEY
    assert agent.state == "armed"


def test_a_lost_frame_is_reported_remembered_and_needs_a_new_lock():
    agent = capturing_agent()
    (report,) = agent.handle(FrameLost(KEY, "timed out"), at(2))
    assert report.failure.reason == "timed out"
    assert agent.inventory().failures == (report.failure,)
    assert agent.state == "idle"


def test_a_spooled_frame_is_published_ever_less_often_until_acknowledged():
    agent = capturing_agent()
    assert agent.handle(FrameSpooled(MANIFEST), at(1)) == [Publish(MANIFEST)]
    assert agent.handle(AgentTick(), at(50)) == [], "one sending at a time"
    agent.handle(Sent(KEY), at(50))
    assert agent.handle(AgentTick(), at(54.9)) == []
    assert agent.handle(AgentTick(), at(55)) == [Publish(MANIFEST)]
    agent.handle(Sent(KEY), at(55))
    assert agent.handle(AgentTick(), at(64.9)) == []
    assert agent.handle(AgentTick(), at(65)) == [Publish(MANIFEST)]
    assert agent.handle(Acknowledged(Ack("n", KEY, ONE)), at(66)) == [Free(KEY, ONE)]
    assert agent.handle(AgentTick(), at(999)) == []
    assert agent.spooled == 0


@pytest.mark.parametrize(
    "ack",
    [Ack("n", KEY, TWO), Ack("m", KEY, ONE), Ack("n", replace(KEY, fire_at_ns=5), ONE)],
    ids=["another hash", "another node", "another session of the same name"],
)
def test_only_the_matching_acknowledgement_frees(ack):
    agent = capturing_agent()
    agent.handle(FrameSpooled(MANIFEST), at(1))
    assert agent.handle(Acknowledged(ack), at(2)) == []
    assert agent.spooled == 1


def test_an_image_unknown_to_the_controller_is_kept_but_not_sent_again():
    agent = capturing_agent()
    agent.handle(FrameSpooled(MANIFEST), at(1))
    agent.handle(Sent(KEY), at(1))
    assert agent.handle(Acknowledged(Ack("n", KEY, ONE, "unknown")), at(2)) == []
    assert agent.handle(AgentTick(), at(1000)) == []
    assert agent.inventory().manifests == (MANIFEST,)
    assert agent.handle(FetchAsked(KEY, 5), at(1001)) == [AnswerImage(5, MANIFEST)]


def test_a_restarted_node_delivers_its_spool_and_does_not_retake_what_it_delivered():
    other = CaptureKey("s", "0002-board", 102 * SECOND)
    agent = Agent("n", NOW, spooled=[MANIFEST], freed=[other])
    assert agent.handle(AgentTick(), NOW) == [Publish(MANIFEST)]
    for key in (KEY, other):
        (answer,) = agent.handle(Triggered(Trigger(key, "board"), 1), NOW)
        assert answer.message.verdict == "accepted"


def test_the_inventory_tells_what_is_under_way_and_a_missing_image_is_declined():
    agent = capturing_agent()
    (answer,) = agent.handle(InventoryAsked(9), NOW)
    assert answer.message.capturing == KEY
    assert isinstance(agent.handle(FetchAsked(KEY, 9), NOW)[0], Decline)


def test_an_image_on_its_way_is_not_given_a_second_time_beside():
    agent = capturing_agent()
    assert agent.handle(FrameSpooled(MANIFEST), at(1)) == [Publish(MANIFEST)]
    assert isinstance(agent.handle(FetchAsked(KEY, 9), at(1))[0], Decline)
    agent.handle(Sent(KEY), at(2))
    assert agent.handle(FetchAsked(KEY, 10), at(2)) == [AnswerImage(10, MANIFEST)]


def test_a_node_that_captures_does_not_change_its_camera():
    agent = capturing_agent()
    (answer,) = agent.handle(arm(TWO), NOW)
    assert answer.message.armed is False
    assert agent.state == "capturing"


def test_a_delivered_image_is_listed_and_given_as_long_as_it_is_held():
    agent = capturing_agent()
    agent.handle(FrameSpooled(MANIFEST), at(1))
    agent.handle(Acknowledged(Ack("n", KEY, ONE)), at(2))
    assert agent.inventory().manifests == ()
    assert agent.inventory().delivered == (MANIFEST,)
    assert agent.handle(FetchAsked(KEY, 9), at(3)) == [AnswerImage(9, MANIFEST)]
    agent.handle(DeliveredRemoved((KEY,)), at(4))
    assert agent.inventory().delivered == ()
    assert isinstance(agent.handle(FetchAsked(KEY, 9), at(5))[0], Decline)


def test_all_delivered_images_have_their_turn_in_the_inventory():
    held = [replace(MANIFEST, key=replace(KEY, fire_at_ns=n)) for n in range(300)]
    agent = Agent("n", NOW, delivered=held)
    lists = [agent.inventory().delivered for _ in range(7)]
    assert max(map(len, lists)) <= 64
    assert {manifest.key for each in lists for manifest in each} == {manifest.key for manifest in held}
    assert all(held[-1] in each for each in lists), "the newest is always there"


def test_a_trigger_for_other_settings_than_the_cameras_is_refused_with_both():
    agent = armed_agent()
    agent.handle(arm(TWO, 4), NOW)  # somebody else's
    agent.handle(CameraLocked(ArmReply("n", True, TWO)), NOW)
    (answer,) = agent.handle(Triggered(Trigger(KEY, "board", settings_hash=ONE), 7), NOW)
    assert answer.message.verdict == "not armed"
    assert "22222222" in answer.message.reason
    assert "11111111" in answer.message.reason
    assert agent.state == "armed"
    taken = agent.handle(Triggered(Trigger(KEY, "board", settings_hash=TWO), 8), NOW)
    assert [type(action) for action in taken] == [Answer, TakeFrame]


def test_a_node_without_room_refuses_to_arm_though_its_camera_is_locked():
    agent = armed_agent()
    (answer,) = agent.handle(replace(arm(question=2), obstacle="no room"), NOW)
    assert (answer.message.armed, answer.message.reason) == (False, "no room")
    (answer,) = agent.handle(arm(question=3), NOW)
    assert answer.message.armed is True


@pytest.mark.parametrize("ahead", [FURTHEST_NS + 1, 3600 * SECOND, 2**62], ids=["a little", "an hour", "absurd"])
def test_a_trigger_too_far_ahead_is_refused_with_a_sentence_and_the_node_stays_armed(ahead):
    agent = armed_agent()
    key = replace(KEY, fire_at_ns=NOW.wall_ns + ahead)
    for _ in range(2):
        answer, *_ = agent.handle(Triggered(Trigger(key, "board"), 7), NOW)
        assert answer.message.verdict == "refused"
        assert "ahead" in answer.message.reason
        assert agent.state == "armed"
    assert agent.inventory().failures[0].key == key
    assert any(isinstance(a, TakeFrame) for a in agent.handle(trigger(), NOW)), "the next trigger is taken"


def test_the_moment_is_that_of_the_controllers_clock_where_it_is_known():
    """The node's wall clock is an hour ahead: by it, the moment would have passed."""
    hour = 3600 * SECOND
    now = Instant(NOW.wall_ns + hour, 5 * SECOND)
    known = Trigger(KEY, "board", clock_zero_ns=NOW.wall_ns - 5 * SECOND, clock_offset_ns=hour, clock_error_ns=9)
    (answer, _) = armed_agent().handle(Triggered(known, 7), now)
    assert answer.message.verdict == "accepted"
    (answer, _) = armed_agent().handle(Triggered(Trigger(KEY, "board"), 7), now)
    assert answer.message.verdict == "missed"


def test_a_node_does_not_stay_capturing_for_longer_than_the_limit():
    agent = capturing_agent()
    end = 1.0 + CAPTURE_LIMIT_NS / SECOND
    assert agent.handle(AgentTick(), at(end - 0.1)) == []
    assert agent.state == "capturing"
    hour_back = Instant(NOW.wall_ns - 3600 * SECOND, at(end).monotonic_ns)
    (report,) = agent.handle(AgentTick(), hour_back)
    assert "hangs" in report.failure.reason
    assert agent.state == "idle"
    assert agent.handle(FrameSpooled(MANIFEST), at(end + 1)) == [Publish(MANIFEST)], (
        "a frame that comes after all is kept"
    )


def test_a_node_does_not_stay_arming_for_longer_than_the_limit():
    agent = Agent("n", NOW)
    agent.handle(arm(), NOW)
    assert agent.handle(AgentTick(), at(LOCK_LIMIT_NS / SECOND - 1)) == []
    (answer,) = agent.handle(AgentTick(), at(LOCK_LIMIT_NS / SECOND))
    assert (answer.message.armed, agent.state) == (False, "idle")
    assert "hangs" in answer.message.reason
