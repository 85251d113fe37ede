"""The controller's capture round as a state machine without input or output: an event comes in, actions go out.

Needs the standard library only. Times are ns since the Unix epoch by the controller's wall clock as it stood when the
round began, and go on evenly from there, so that a clock that is set meanwhile lengthens or shortens no wait::

    arming       SendArm until every expected camera is armed with a measured clock or the arm deadline passes
                 → refused     a camera is not armed and the operator did not override
                 → triggering  OpenCapture (the record exists before any camera fires), SendTrigger
    triggering   SendTrigger again to whoever has not answered, until the planned moment
                 → collecting  the moment has passed
    collecting   images are pushed by the nodes; after a while AskInventory and FetchImage pull what is missing
                 → closed      nothing is pending, or whoever is pending has gone, or the deadline passed

Every expected camera ends ok or failed with a reason. An image that arrives after the close is archived as well and
turns the camera's status to delivered-late; `ringdic_controller.rig.judgement` decides about every image by itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ringdic_node.wire import ArmReply, CaptureKey, Failure, Inventory, TriggerReply

from ringdic_controller.rig.clocks import NodeTiming, clock_fault
from ringdic_controller.rig.frame_grid import FrameTiming, common_grid, frame_timing
from ringdic_controller.rig.round_steps import (
    Action,
    ArmAnswered,
    AskInventory,
    CameraOutcome,
    CaptureOpened,
    CloseCapture,
    Event,
    FailureReported,
    FetchImage,
    ImageArchived,
    InventoryAnswered,
    NodeBack,
    NodeDoubled,
    NodeGone,
    NoteOutcome,
    OpenCapture,
    RefuseRound,
    RoundTick,
    SendArm,
    SendTrigger,
    TriggerAnswered,
)

MS = 1_000_000
SECOND = 1_000_000_000


@dataclass(frozen=True)
class Timing:
    """Waits of a capture round, ns; all positive."""

    arm: int = 15 * SECOND  # for the answers of cameras that are to arm
    arm_retry: int = 3 * SECOND
    lead: int = 400 * MS  # from the first trigger message to the moment that it plans
    trigger_retry: int = 80 * MS
    pull_after: int = 3 * SECOND  # from the planned moment to the first question for missing images
    pull_every: int = 3 * SECOND
    collect: int = 60 * SECOND  # from the planned moment to the close, whatever is missing
    gone_grace: int = 2 * SECOND  # a node that disappears for less is not given up

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value <= 0:
                raise ValueError(f"the round's wait '{name}' must be positive, not {value} ns")


class CaptureRound:
    """One capture of all cameras, from arming to the close.

    Parameters
    ----------
    cameras
        Ids of the expected cameras.
    timing
        Waits of the round.
    now
        Present time, ns, on the clock of every later call.
    absent
        Ids of those cameras that are not connected as the round begins.
    doubled
        By camera, the sentence about two processes that speak as its node.
    override
        Fire although cameras are not armed; those end as failed with their reason.
    settings_hash
        Hash of the settings that the cameras must be locked to; a camera that is locked to others is not armed.
    tolerance
        Largest skew that is not flagged, ns: a camera whose clock is not known as well as that is not armed. None:
        clocks are not asked for.

    Raises ValueError if there is no camera or one is named twice.
    """

    def __init__(
        self,
        cameras: Iterable[str],
        timing: Timing,
        now: int,
        *,
        absent: Iterable[str] = (),
        doubled: Mapping[str, str] | None = None,
        override: bool = False,
        settings_hash: str | None = None,
        tolerance: int | None = None,
    ) -> None:
        self.cameras = tuple(cameras)
        if not self.cameras or len(set(self.cameras)) != len(self.cameras):
            raise ValueError("a capture needs at least one camera and no camera twice")
        self.timing = timing
        self.state = "arming"
        self.key: CaptureKey | None = None
        self.outcomes = {camera: CameraOutcome() for camera in self.cameras}
        self._override = override
        self._settings_hash = settings_hash
        self._doubled = dict(doubled or {})
        self._tolerance = tolerance
        self._timings: dict[str, NodeTiming] = {}
        self._arm_deadline = now + timing.arm
        self._next_send = now
        self._armed: dict[str, ArmReply] = {}
        self._refusals: dict[str, str] = {}
        self._verdicts: dict[str, TriggerReply] = {}
        self._absent_since = dict.fromkeys(absent, now)
        self._next_pull = 0

    @property
    def over(self) -> bool:
        """Whether the round has ended, closed or refused."""
        return self.state in ("closed", "refused")

    @property
    def deadline(self) -> int | None:
        """Time at which the round closes whatever is missing, ns; None before the capture is open."""
        return None if self.key is None else self.key.fire_at_ns + self.timing.collect

    @property
    def pending(self) -> tuple[str, ...]:
        """Ids of the cameras that have no outcome yet."""
        return tuple(camera for camera in self.cameras if self.outcomes[camera].status == "pending")

    def handle(self, event: Event, now: int) -> list[Action]:
        """Take one event at a time ``now``, ns; return the actions to perform, in order. None after the end."""
        if self.over:
            return []
        actions: list[Action] = []
        match event:
            case ArmAnswered():
                self._note_arm(event)
            case CaptureOpened():
                actions += self._opened(event.key, now)
            case TriggerAnswered():
                actions += self._note_verdict(event.reply)
            case ImageArchived():
                if self._expects(event.manifest.node, event.manifest.key):
                    actions += self._settle(event.manifest.node, CameraOutcome("ok"))
            case FailureReported():
                actions += self._note_failure(event.failure)
            case InventoryAnswered():
                actions += self._note_inventory(event.inventory, now)
            case NodeGone():
                self._absent_since.setdefault(event.camera, now)
            case NodeBack():
                self._absent_since.pop(event.camera, None)
            case NodeDoubled():
                self._doubled[event.camera] = event.reason
            case RoundTick():
                pass
        return actions + self._advance(now)

    def _expects(self, camera: str, key: CaptureKey) -> bool:
        return camera in self.outcomes and self.key == key

    def _is_absent(self, camera: str, now: int) -> bool:
        """Whether a camera's node has been without connection for longer than a short interruption."""
        return camera in self._absent_since and now - self._absent_since[camera] >= self.timing.gone_grace

    def _advance(self, now: int) -> list[Action]:
        """Make the transitions that are due at a time; the actions that they need."""
        if self.state == "arming":
            return self._advance_arming(now)
        if self.state == "triggering":
            return self._advance_triggering(now)
        if self.state == "collecting":
            return self._advance_collecting(now)
        return []

    # Arming

    def _note_arm(self, event: ArmAnswered) -> None:
        reply = event.reply
        if reply.node not in self.outcomes or self.state != "arming":
            return
        fault = clock_fault(event.timing, self._tolerance) if reply.armed and self._tolerance is not None else None
        if reply.armed and self._settings_hash not in (None, reply.settings_hash):
            self._armed.pop(reply.node, None)
            self._refusals[reply.node] = f"the camera is locked to other settings ({reply.settings_hash[:8]}…)"
        elif reply.armed and fault is None:
            self._armed[reply.node] = reply
            self._refusals.pop(reply.node, None)
            if event.timing is not None:
                self._timings[reply.node] = event.timing
        elif fault is not None:
            self._refusals[reply.node] = fault
        elif reply.node not in self._armed:
            self._refusals[reply.node] = reply.reason

    def _advance_arming(self, now: int) -> list[Action]:
        missing = tuple(c for c in self.cameras if c not in self._armed or self._doubled.get(c))
        # A camera that is not connected, or twice, cannot arm; one that refused may still do so before the deadline.
        awaited = tuple(c for c in missing if not self._is_absent(c, now) and not self._doubled.get(c))
        if awaited and now < self._arm_deadline:
            if now < self._next_send:
                return []
            self._next_send = now + self.timing.arm_retry
            return [SendArm(tuple(camera for camera in missing if not self._doubled.get(camera)))]
        reasons = {camera: self._why_not_armed(camera) for camera in missing}
        if missing and (not self._override or len(missing) == len(self.cameras)):
            self.state = "refused"
            return [RefuseRound(reasons)]
        self.state = "opening"
        notes: list[Action] = []
        for camera, reason in reasons.items():
            notes += self._settle(camera, CameraOutcome("failed", reason))
        armed = {camera: reply for camera, reply in self._armed.items() if camera not in reasons}
        grid = common_grid(self._frames(), self._tolerance)
        earliest = now + self.timing.lead
        return [*notes, OpenCapture(grid.at_or_after(earliest) if grid else earliest, reasons, armed, grid)]

    def _why_not_armed(self, camera: str) -> str:
        if self._doubled.get(camera):
            return f"not armed: {self._doubled[camera]}"
        if camera in self._refusals:
            return f"not armed: {self._refusals[camera]}"
        if camera in self._absent_since:
            return "not armed: the node is not connected"
        return f"not armed: no answer within {self.timing.arm / SECOND:g} s"

    def _frames(self) -> dict[str, FrameTiming]:
        """Frame times of the armed cameras that take frames continuously: as measured with the clock, or as armed."""
        frames = {}
        for camera, reply in self._armed.items():
            timing = self._timings.get(camera)
            if timing is not None and timing.frames is not None:
                frames[camera] = timing.frames
            else:
                armed_at = frame_timing(reply.frame_time_ns, reply.frame_period_ns, timing.offset_ns if timing else 0)
                if armed_at is not None:
                    frames[camera] = armed_at
        return frames

    # Triggering

    def _opened(self, key: CaptureKey, now: int) -> list[Action]:
        if self.state != "opening":
            return []
        self.key = key
        self.state = "triggering"
        self._next_send = now
        self._next_pull = key.fire_at_ns + self.timing.pull_after
        return []

    def _note_verdict(self, reply: TriggerReply) -> list[Action]:
        if not self._expects(reply.node, reply.key):
            return []
        earlier = self._verdicts.get(reply.node)
        if earlier is None or earlier.verdict == "not armed":
            self._verdicts[reply.node] = reply
        if reply.verdict in ("missed", "refused"):
            return self._settle(reply.node, CameraOutcome("failed", reply.reason or f"the trigger was {reply.verdict}"))
        return []

    def _advance_triggering(self, now: int) -> list[Action]:
        assert self.key is not None
        if now >= self.key.fire_at_ns:
            self.state = "collecting"
            return self._advance_collecting(now)
        unanswered = tuple(
            camera
            for camera in self.pending
            if camera not in self._verdicts or self._verdicts[camera].verdict == "not armed"
        )
        if not unanswered or now < self._next_send:
            return []
        self._next_send = now + self.timing.trigger_retry
        return [SendTrigger(unanswered, self.key)]

    # Collecting

    def _note_failure(self, failure: Failure) -> list[Action]:
        if not self._expects(failure.node, failure.key):
            return []
        return self._settle(failure.node, CameraOutcome("failed", failure.reason))

    def _note_inventory(self, inventory: Inventory, now: int) -> list[Action]:
        key, camera = self.key, inventory.node
        if key is None or camera not in self.outcomes or self.outcomes[camera].status == "ok":
            return []
        for manifest in (*inventory.manifests, *inventory.delivered):
            if manifest.key == key:
                return [FetchImage(manifest)]
        for failure in inventory.failures:
            if failure.key == key:
                return self._note_failure(failure)
        # The node was asked after the planned moment: it will reject a trigger that is still on its way.
        if inventory.capturing != key and now > key.fire_at_ns + self.timing.pull_after:
            return self._settle(camera, CameraOutcome("failed", self._why_missing(camera)))
        return []

    def _why_missing(self, camera: str) -> str:
        verdict = self._verdicts.get(camera)
        if verdict is None:
            return "the trigger did not reach the node"
        if verdict.verdict == "not armed":
            return f"not armed when the trigger came: {verdict.reason}"
        return "the node accepted the trigger but holds no image; it was probably restarted before it had stored one"

    def _advance_collecting(self, now: int) -> list[Action]:
        assert self.key is not None
        pending = self.pending
        absent = [camera for camera in pending if self._is_absent(camera, now)]
        if len(absent) < len(pending) and now < self.key.fire_at_ns + self.timing.collect:
            if now < self._next_pull:
                return []
            self._next_pull = now + self.timing.pull_every
            return [AskInventory(tuple(camera for camera in pending if camera not in absent))]
        actions: list[Action] = []
        for camera in pending:
            actions += self._settle(camera, CameraOutcome("failed", self._why_unfinished(camera)))
        self.state = "closed"
        return [*actions, CloseCapture(dict(self.outcomes))]

    def _why_unfinished(self, camera: str) -> str:
        verdict = self._verdicts.get(camera)
        after_trigger = " after it had accepted the trigger" if verdict and verdict.verdict == "accepted" else ""
        if camera in self._absent_since:
            return f"the node disappeared{after_trigger}, before its image arrived"
        if verdict is None:
            return "the node did not answer the trigger and no image arrived by the deadline"
        return f"no image arrived within {self.timing.collect / SECOND:g} s of the planned moment"

    def _settle(self, camera: str, outcome: CameraOutcome) -> list[Action]:
        """Set a camera's outcome; an archived image outweighs every report of failure."""
        present = self.outcomes[camera]
        if present == outcome or present.status == "ok":
            return []
        self.outcomes[camera] = outcome
        return [NoteOutcome(camera, outcome)]
