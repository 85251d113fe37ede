"""The node's state machine: each event that it is given yields the actions to perform. It does no input or output.

States and what moves them (anything not listed leaves the state alone)::

    state       event                       next state
    idle        ArmAsked                    arming      LockCamera
    arming      CameraLocked                armed       Answer(armed) to every waiting question
    arming      CameraRefused               idle        Answer(not armed)
    arming      LOCK_LIMIT_NS have passed   idle        Answer(not armed)
    armed       ArmAsked, same settings     armed       Answer(armed)
    armed       ArmAsked, other settings    arming      LockCamera
    armed       Triggered, in time          capturing   Answer(accepted), TakeFrame
    armed       Triggered, moment passed    armed       Answer(missed), Report(failure)
    armed       Triggered, too far ahead    armed       Answer(refused), Report(failure)
    capturing   FrameSpooled                armed       Publish
    capturing   FrameLost                   idle        Report(failure); the camera must be locked anew
    capturing   CAPTURE_LIMIT_NS beyond     idle        Report(failure); a frame that comes later is spooled
                the moment have passed

Laws: a capture is taken at most once, however often its trigger arrives. A spooled image is published
again and again, each time after a longer wait, until an acknowledgement with its own hash arrives; only then may it
be removed. As long as it is held it is listed and given, since the acknowledgement may not have come from the
controller. An image that the controller declares unknown stays in the spool and is not published any more.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from ringdic_node.agent_events import (
    Acknowledged,
    Action,
    AgentTick,
    Answer,
    AnswerImage,
    ArmAsked,
    CameraLocked,
    CameraRefused,
    Decline,
    DeliveredRemoved,
    Event,
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
from ringdic_node.clock import Instant, RigClock
from ringdic_node.wire import (
    Ack,
    Arm,
    ArmReply,
    CaptureKey,
    Failure,
    Inventory,
    Manifest,
    Trigger,
    TriggerReply,
)

REMEMBERED = 200  # failures and answers kept for repeated questions
LISTED_NEWEST, LISTED_IN_TURN = 16, 48  # delivered images in one inventory
FURTHEST_NS = 30_000_000_000  # a trigger whose moment is further ahead is refused: a node waits no longer for a moment
CAPTURE_LIMIT_NS = 60_000_000_000  # beyond the moment of a capture, for its frame to be in the spool
LOCK_LIMIT_NS = 90_000_000_000  # for a camera to be locked or refused


@dataclass
class _Parcel:
    """A spooled image to deliver: when it is published next and the wait after that, ns of the monotonic clock."""

    manifest: Manifest
    due_ns: int
    wait_ns: int
    sending: bool = False
    unwanted: bool = False


class Agent:
    """Decides what a node does on each event: when it locks, captures, publishes and frees.

    Parameters
    ----------
    node : str
        This node's id.
    spooled, delivered
        What the spool held when the process started: images to deliver, and images delivered and still held.
    freed
        Captures delivered before, whether their images are held or not.
    failures
        Captures whose images the spool holds but cannot use, with the reason.
    now : Instant
        The moment of the start; the spooled images are due at once.
    resend_after_ns, resend_at_most_ns : int
        First and longest wait for an acknowledgement before the image is published again.
    """

    def __init__(
        self,
        node: str,
        now: Instant,
        *,
        spooled: Iterable[Manifest] = (),
        delivered: Iterable[Manifest] = (),
        freed: Iterable[CaptureKey] = (),
        failures: Iterable[Failure] = (),
        resend_after_ns: int = 5_000_000_000,
        resend_at_most_ns: int = 60_000_000_000,
    ) -> None:
        self.node = node
        self._resend_after = resend_after_ns
        self._resend_at_most = resend_at_most_ns
        self._lock_reply: ArmReply | None = None
        self._arming: Arm | None = None
        self._until_ns = 0  # end of the wait for the camera, by the monotonic clock
        self._waiting: list[tuple[int, str]] = []
        self._capturing: Trigger | None = None
        self._parcels = {m.key: _Parcel(m, now.monotonic_ns, resend_after_ns) for m in spooled}
        self._delivered: OrderedDict[CaptureKey, Manifest] = OrderedDict((m.key, m) for m in delivered)
        self._listed = 0  # how far the delivered images have been listed
        self._freed: OrderedDict[CaptureKey, None] = OrderedDict.fromkeys((*freed, *self._delivered))
        self._failures: OrderedDict[CaptureKey, Failure] = OrderedDict((failure.key, failure) for failure in failures)
        self._verdicts: OrderedDict[CaptureKey, TriggerReply] = OrderedDict()

    @property
    def state(self) -> str:
        """One of ``wire.NODE_STATES``: capturing, arming, armed or idle."""
        if self._capturing is not None:
            return "capturing"
        if self._arming is not None:
            return "arming"
        return "armed" if self._lock_reply is not None else "idle"

    @property
    def armed(self) -> bool:
        """Whether the camera is locked to the settings that were asked for last."""
        return self._lock_reply is not None

    @property
    def spooled(self) -> int:
        """Number of images that wait for an acknowledgement."""
        return len(self._parcels)

    @property
    def unwanted(self) -> int:
        """Number of images among them that the controller has declared unknown."""
        return sum(parcel.unwanted for parcel in self._parcels.values())

    def handle(self, event: Event, now: Instant) -> list[Action]:
        """Take one event at the moment ``now``; return the actions to perform, in order."""
        match event:
            case ArmAsked():
                return self._arm(event, now)
            case CameraLocked():
                return self._locked(event.reply)
            case CameraRefused():
                return self._refused(event)
            case Triggered():
                return self._triggered(event, now)
            case FrameSpooled():
                return self._frame_spooled(event.manifest, now)
            case FrameLost():
                return self._frame_lost(event)
            case Sent():
                return self._sent(event.key, now)
            case Acknowledged():
                return self._acknowledged(event.message)
            case DeliveredRemoved():
                for key in event.keys:
                    self._delivered.pop(key, None)
                return []
            case InventoryAsked():
                return [Answer(event.question, self.inventory())]
            case FetchAsked():
                return self._fetch(event)
            case AgentTick():
                return [*self._overdue(now), *self._due(now)]

    def inventory(self) -> Inventory:
        """The answer to an inventory query: images in the spool, failures, the capture under way.

        Each call lists other delivered images beside the newest, until all have had their turn.
        """
        return Inventory(
            node=self.node,
            manifests=tuple(parcel.manifest for parcel in self._parcels.values()),
            failures=tuple(self._failures.values()),
            capturing=self._capturing.key if self._capturing else None,
            delivered=self._next_delivered(),
        )

    def _next_delivered(self) -> tuple[Manifest, ...]:
        manifests = list(self._delivered.values())
        older, newest = manifests[:-LISTED_NEWEST], manifests[-LISTED_NEWEST:]
        begin = self._listed if self._listed < len(older) else 0
        self._listed = begin + LISTED_IN_TURN
        return (*newest, *older[begin : self._listed])

    # Arming

    def _arm(self, event: ArmAsked, now: Instant) -> list[Action]:
        wanted, obstacle = event.message, event.obstacle
        if self._capturing is not None:
            obstacle = f"a capture is under way ({self._capturing.key})"
        elif self._arming is not None and self._arming.settings_hash != wanted.settings_hash:
            obstacle = "the camera is being locked to other settings; ask again"
        if obstacle:
            reply = ArmReply(self.node, armed=False, settings_hash=wanted.settings_hash, reason=obstacle)
            return [Answer(event.question, reply)]
        if self._arming is not None:  # one lock at a time: the same settings share its answer
            self._waiting.append((event.question, wanted.settings_hash))
            return []
        if self._lock_reply is not None and self._lock_reply.settings_hash == wanted.settings_hash:
            return [Answer(event.question, self._lock_reply)]
        self._lock_reply = None
        self._arming = wanted
        self._until_ns = now.monotonic_ns + LOCK_LIMIT_NS
        self._waiting = [(event.question, wanted.settings_hash)]
        return [LockCamera(wanted.settings, wanted.settings_hash)]

    def _locked(self, reply: ArmReply) -> list[Action]:
        if self._arming is None or reply.settings_hash != self._arming.settings_hash:
            return []
        self._lock_reply = reply
        return self._answer_waiting(reply)

    def _refused(self, event: CameraRefused) -> list[Action]:
        if self._arming is None or event.settings_hash != self._arming.settings_hash:
            return []
        return self._answer_waiting(
            ArmReply(self.node, armed=False, settings_hash=event.settings_hash, reason=event.reason)
        )

    def _answer_waiting(self, reply: ArmReply) -> list[Action]:
        waiting, self._waiting, self._arming = self._waiting, [], None
        return [Answer(question, reply) for question, _ in waiting]

    # Capturing

    def _triggered(self, event: Triggered, now: Instant) -> list[Action]:
        trigger, key = event.message, event.message.key
        known = self._verdicts.get(key)
        if known is not None:
            return [Answer(event.question, known)]
        if key in self._parcels or key in self._freed:
            return [Answer(event.question, TriggerReply(self.node, key, "accepted"))]
        if self.state != "armed":
            reason = f"the node is {self.state}"
            return [Answer(event.question, TriggerReply(self.node, key, "not armed", reason))]
        assert self._lock_reply is not None
        if trigger.settings_hash not in ("", self._lock_reply.settings_hash):
            reason = (
                f"the camera is locked to other settings ({self._lock_reply.settings_hash[:8]}…) than the capture's "
                f"({trigger.settings_hash[:8]}…), because somebody armed it in between; capture again"
            )
            return [Answer(event.question, TriggerReply(self.node, key, "not armed", reason))]
        ahead = key.fire_at_ns - RigClock(trigger.clock_zero_ns).time_ns(now)
        whose = "this node's clock" if trigger.clock_zero_ns is None else "the controller's clock"
        if ahead < 0:
            return self._dismiss(event, "missed", f"the trigger arrived {_span(-ahead)} after its moment by {whose}")
        if ahead > FURTHEST_NS:
            reason = (
                f"the trigger's moment is {_span(ahead)} ahead by {whose}, and a node waits at most "
                f"{_span(FURTHEST_NS)}; check the clocks of controller and node"
            )
            return self._dismiss(event, "refused", reason)
        verdict = TriggerReply(self.node, key, "accepted")
        self._remember(self._verdicts, key, verdict)
        self._capturing = trigger
        self._until_ns = now.monotonic_ns + ahead + CAPTURE_LIMIT_NS
        return [Answer(event.question, verdict), TakeFrame(trigger)]

    def _dismiss(self, event: Triggered, word: str, reason: str) -> list[Action]:
        """Answer a trigger whose capture is not taken, now or when it is repeated."""
        verdict = TriggerReply(self.node, event.message.key, word, reason)
        self._remember(self._verdicts, event.message.key, verdict)
        return [Answer(event.question, verdict), *self._fail(event.message.key, reason)]

    def _overdue(self, now: Instant) -> list[Action]:
        """Give up a camera that has neither delivered nor refused for too long."""
        if now.monotonic_ns < self._until_ns:
            return []
        if self._capturing is not None:
            reason = (
                f"no frame was in the spool {_span(CAPTURE_LIMIT_NS)} after the moment; the camera or the disk hangs"
            )
            return self._frame_lost(FrameLost(self._capturing.key, reason))
        if self._arming is not None:
            reason = f"the camera was not locked within {_span(LOCK_LIMIT_NS)}; it hangs"
            return self._refused(CameraRefused(self._arming.settings_hash, reason))
        return []

    def _frame_spooled(self, manifest: Manifest, now: Instant) -> list[Action]:
        if self._capturing is not None and self._capturing.key == manifest.key:
            self._capturing = None
        if manifest.key in self._parcels or manifest.key in self._freed:
            return []
        self._parcels[manifest.key] = _Parcel(manifest, now.monotonic_ns, self._resend_after)
        return self._due(now)

    def _frame_lost(self, event: FrameLost) -> list[Action]:
        if self._capturing is not None and self._capturing.key == event.key:
            self._capturing = None
            self._lock_reply = None
        return self._fail(event.key, event.reason)

    def _fail(self, key: CaptureKey, reason: str) -> list[Action]:
        failure = Failure(self.node, key, reason)
        self._remember(self._failures, key, failure)
        return [Report(failure)]

    @staticmethod
    def _remember(memory: OrderedDict[CaptureKey, Any], key: CaptureKey, value: object) -> None:
        memory[key] = value
        while len(memory) > REMEMBERED:
            memory.popitem(last=False)

    # Delivering

    def _due(self, now: Instant) -> list[Action]:
        actions: list[Action] = []
        for parcel in self._parcels.values():
            if not parcel.sending and not parcel.unwanted and parcel.due_ns <= now.monotonic_ns:
                parcel.sending = True
                actions.append(Publish(parcel.manifest))
        return actions

    def _sent(self, key: CaptureKey, now: Instant) -> list[Action]:
        parcel = self._parcels.get(key)
        if parcel is not None:
            parcel.sending = False
            parcel.due_ns = now.monotonic_ns + parcel.wait_ns
            parcel.wait_ns = min(2 * parcel.wait_ns, self._resend_at_most)
        return []

    def _acknowledged(self, ack: Ack) -> list[Action]:
        parcel = self._parcels.get(ack.key)
        if parcel is None or ack.node != self.node or ack.sha256 != parcel.manifest.sha256:
            return []
        if ack.verdict == "unknown":
            parcel.unwanted = True
            return []
        del self._parcels[ack.key]
        self._delivered[ack.key] = parcel.manifest
        self._remember(self._freed, ack.key, None)
        return [Free(ack.key, ack.sha256)]

    def _fetch(self, event: FetchAsked) -> list[Action]:
        parcel = self._parcels.get(event.key)
        if parcel is None and event.key in self._delivered:
            return [AnswerImage(event.question, self._delivered[event.key])]
        if parcel is None:
            return [Decline(event.question, f"node {self.node} holds no image of {event.key}")]
        if parcel.sending:
            return [Decline(event.question, f"node {self.node} is sending the image of {event.key} at this moment")]
        return [AnswerImage(event.question, parcel.manifest)]


def _span(duration_ns: int) -> str:
    """A duration in words: ms below a second, else s."""
    return f"{duration_ns / 1e6:.1f} ms" if duration_ns < 1e9 else f"{duration_ns / 1e9:.0f} s"
