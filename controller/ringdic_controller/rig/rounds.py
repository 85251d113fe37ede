"""Loop that performs a capture round: it does what the state machine decides, with nodes, record and events."""

from __future__ import annotations

import dataclasses
import logging
import queue
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from ringdic.errors import ComputationError
from ringdic.session.records import CaptureRecord
from ringdic.session.writer import CaptureWriter, SessionWriter
from ringdic_node.wire import Arm, ArmReply, CaptureKey, Manifest, Trigger, hash_of_settings

from ringdic_controller.rig import capture as steps
from ringdic_controller.rig.capture import SECOND, CaptureRound, Timing
from ringdic_controller.rig.clocks import NodeTiming, wall_start_ns
from ringdic_controller.rig.frame_grid import off_grid

log = logging.getLogger(__name__)

TRIGGER_ANSWER_TIMEOUT = 5.0
INVENTORY_TIMEOUT = 5.0
HEARTBEAT = 0.02


class CaptureRefusedError(ComputationError):
    """No image was taken, because cameras are not armed. reasons : by camera, why it is not armed."""

    def __init__(self, reasons: dict[str, str]) -> None:
        self.reasons = reasons
        by_camera = "; ".join(f"{camera}: {reason}" for camera, reason in reasons.items())
        super().__init__(f"not captured, because not every camera is armed ({by_camera}); mend it or override")


class NodeQueries(Protocol):
    """What a round asks of the nodes; `ringdic_controller.rig.link.RigLink` does it over the network."""

    def timing(self, camera: str, start_ns: int) -> NodeTiming | None:
        """What is known of a node's clock and frames; None if it was not measured.

        start_ns : time at which the controller's monotonic clock was zero, ns since the Unix epoch.
        """

    def ask(
        self, camera: str, question: Arm | Trigger | None, on_answer: Callable[[Any], None], timeout: float
    ) -> None:
        """Ask a node to arm, to capture or, with None, for its inventory; returns at once.

        ``on_answer`` is called from another thread within ``timeout`` seconds, or never.
        """

    def fetch(self, manifest: Manifest) -> None:
        """Pull an image that a node holds into the intake; returns at once."""

    def close_later(self, writer: CaptureWriter, reasons: Mapping[str, str]) -> None:
        """Close a capture's record, which the disk did not take, as soon as it does; returns at once."""


def run_round(
    nodes: NodeQueries,
    events: queue.Queue[steps.Event],
    session: SessionWriter,
    kind: str,
    *,
    cameras: Sequence[str],
    absent: Sequence[str],
    doubled: Mapping[str, str],
    timing: Timing,
    tolerance_ns: int,
    override: bool,
    settings: dict[str, Any],
    on_event: Callable[[dict[str, Any]], None],
    wall_ns: Callable[[], int] = time.time_ns,
    monotonic_ns: Callable[[], int] = time.monotonic_ns,
) -> CaptureRecord:
    """Run one capture round to its end and return the closed record.

    Parameters
    ----------
    nodes
        Takes the questions to the nodes.
    events
        Brings what happens meanwhile: archived images, failures, nodes that go and come back.
    session, kind
        Writer of the session, and kind of the capture.
    cameras, absent
        Ids of the expected cameras, and of those whose node is not connected.
    doubled
        By camera, the sentence about two processes that speak as its node.
    timing, tolerance_ns
        Waits of the round; largest skew that is not flagged, ns.
    override
        Fire although cameras are not armed.
    settings
        Camera settings (exposure, gain, …) that the cameras are locked to.
    on_event
        Called with `capture_event` when the capture has changed.
    wall_ns, monotonic_ns
        Clocks, ns: the first is read at the beginning only, the round waits by the second, which nobody sets.

    Raises CaptureRefusedError if cameras are not armed and ``override`` is not given, or none is armed.
    """
    start_ns, wanted = wall_start_ns(wall_ns, monotonic_ns), hash_of_settings(settings)
    machine = CaptureRound(
        cameras, timing, start_ns + monotonic_ns(), absent=absent, doubled=doubled, override=override,
        settings_hash=wanted, tolerance=tolerance_ns,
    )  # fmt: skip
    performer = _Performer(
        nodes, events, session, kind, tuple(cameras), timing, tolerance_ns, settings, on_event, start_ns
    )
    performer.report_without_record("arming")
    event: steps.Event = steps.RoundTick()
    while True:
        for action in machine.handle(event, start_ns + monotonic_ns()):
            performer.perform(action)
        if machine.over:
            return performer.record()
        event = _next(events)


def _next(events: queue.Queue[steps.Event]) -> steps.Event:
    """The next event, or after a short while that time has passed."""
    try:
        return events.get(timeout=HEARTBEAT)
    except queue.Empty:
        return steps.RoundTick()


class _Performer:
    """Performs the actions that the state machine of one round asks for."""

    def __init__(
        self,
        nodes: NodeQueries,
        events: queue.Queue[steps.Event],
        session: SessionWriter,
        kind: str,
        cameras: tuple[str, ...],
        timing: Timing,
        tolerance_ns: int,
        settings: dict[str, Any],
        on_event: Callable[[dict[str, Any]], None],
        start_ns: int,
    ) -> None:
        self._nodes = nodes
        self._start_ns = start_ns  # the round's time at which the controller's monotonic clock was zero
        self._armed: dict[str, NodeTiming] = {}
        self._events = events
        self._session = session
        self._kind = kind
        self._cameras = cameras
        self._timing = timing
        self._tolerance_ns = tolerance_ns
        self._on_event = on_event
        self._scene = session.count(kind)
        self._writer: CaptureWriter | None = None
        self._arm = Arm(session.name, kind, settings, hash_of_settings(settings), cameras)

    def record(self) -> CaptureRecord:
        """The capture's record as it stands."""
        assert self._writer is not None
        return self._writer.record()

    def perform(self, action: steps.Action) -> None:
        """Perform one action; raises CaptureRefusedError for RefuseRound."""
        match action:
            case steps.SendArm():
                for camera in action.cameras:
                    self._ask(camera, self._arm, self._arm_answered, self._timing.arm / SECOND)
            case steps.OpenCapture():
                self._open(action)
            case steps.SendTrigger():
                for camera in action.cameras:
                    trigger = self._trigger(camera, action.key)
                    self._ask(camera, trigger, steps.TriggerAnswered, TRIGGER_ANSWER_TIMEOUT)
            case steps.AskInventory():
                for camera in action.cameras:
                    self._ask(camera, None, steps.InventoryAnswered, INVENTORY_TIMEOUT)
            case steps.FetchImage():
                self._nodes.fetch(action.manifest)
            case steps.NoteOutcome():
                self._note(action)
            case steps.RefuseRound():
                self.report_without_record("refused", action.reasons)
                raise CaptureRefusedError(action.reasons)
            case steps.CloseCapture():
                assert self._writer is not None
                self._close({camera: outcome.reason or "" for camera, outcome in action.outcomes.items()})

    def _ask(
        self,
        camera: str,
        question: Arm | Trigger | None,
        event: Callable[[Any], steps.Event],
        timeout: float,
    ) -> None:
        """Put a question to a node; its answer comes back to the state machine as an event."""
        self._nodes.ask(camera, question, lambda answer: self._events.put(event(answer)), timeout)

    def _arm_answered(self, reply: ArmReply) -> steps.Event:
        timing = self._nodes.timing(reply.node, self._start_ns)
        if timing is not None and reply.armed:
            self._armed[reply.node] = timing
        return steps.ArmAnswered(reply, timing)

    def _trigger(self, camera: str, key: CaptureKey) -> Trigger:
        """The trigger for one node, with what is known of its clock now, and its offset when it was armed."""
        timing = self._nodes.timing(camera, self._start_ns)
        if timing is None:
            return Trigger(key, self._kind, self._scene, self._arm.settings_hash)
        armed = self._armed.get(camera, timing)
        return Trigger(
            key,
            self._kind,
            self._scene,
            self._arm.settings_hash,
            clock_zero_ns=timing.zero_ns,
            clock_offset_ns=armed.offset_ns,
            clock_error_ns=timing.error_ns,
        )

    def _open(self, action: steps.OpenCapture) -> None:
        try:
            self._writer = self._session.begin_capture(
                self._kind,
                self._cameras,
                fire_at_ns=action.fire_at_ns,
                tolerance_ns=self._tolerance_ns,
                override=bool(action.unarmed),
                settings=self._arm.settings,
                settings_hash=self._arm.settings_hash,
                armed={camera: armed_state(reply) for camera, reply in action.armed.items()},
                frame_grid=action.grid.to_json() if action.grid else None,
            )
        except OSError as error:
            raise ComputationError(
                f"not captured, because the archive takes no record ({error.strerror or error}); "
                "make room on its disk, or make it writable"
            ) from error
        if action.grid is not None and action.grid.off:
            log.warning("%s: %s", self._writer.capture_id, off_grid(action.grid))
        self._events.put(
            steps.CaptureOpened(CaptureKey(self._session.name, self._writer.capture_id, action.fire_at_ns))
        )
        for camera, reason in action.unarmed.items():
            self._fail(camera, reason)
        self._on_event(capture_event(self._writer.record()))

    def _fail(self, camera: str, reason: str) -> None:
        assert self._writer is not None
        try:
            self._writer.fail(camera, reason)
        except OSError as error:  # a full disk; the close writes all reasons once more
            log.warning("capture %s: the failure of %s is not written: %s", self._writer.capture_id, camera, error)

    def _close(self, reasons: dict[str, str]) -> None:
        """Close the record; where the archive's disk takes nothing, later, as soon as there is room."""
        assert self._writer is not None
        writer = self._writer
        try:
            record = writer.close(reasons)
        except OSError as error:
            self._nodes.close_later(writer, reasons)
            raise ComputationError(
                f"the record of capture {writer.capture_id} could not be closed ({error.strerror or error}): make room "
                "on the archive's disk; it is closed then, and the images are fetched from their nodes"
            ) from error
        self._on_event(capture_event(record))

    def _note(self, action: steps.NoteOutcome) -> None:
        if self._writer is None or action.outcome.status != "failed":
            return  # the intake reports an image's arrival
        self._fail(action.camera, action.outcome.reason or "")
        self._on_event(capture_event(self._writer.record()))

    def report_without_record(self, state: str, reasons: dict[str, str] | None = None) -> None:
        """Report a round that has no record: not yet, or because it was refused."""
        self._on_event(
            {
                "type": "capture",
                "session": self._session.name,
                "capture_id": None,
                "kind": self._kind,
                "state": state,
                "skew_ns": None,
                "skew_exceeded": None,
                "cameras": {
                    camera: {
                        "status": "failed" if camera in (reasons or {}) else "pending",
                        "reason": (reasons or {}).get(camera),
                    }
                    for camera in self._cameras
                },
            }
        )


def armed_state(reply: ArmReply) -> dict[str, Any]:
    """What a node answered when it armed, as the capture's record keeps it: all fields but those that only say so."""
    return {
        name: value
        for name, value in dataclasses.asdict(reply).items()
        if name not in ("node", "armed", "reason") and value not in (None, "")
    }


def capture_event(record: CaptureRecord) -> dict[str, Any]:
    """The event that reports a capture's record: its state, and the status of every camera with its reason."""
    names = ("session", "capture_id", "kind", "state", "skew_ns", "skew_exceeded")
    cameras = {camera: {"status": entry.status, "reason": entry.reason} for camera, entry in record.cameras.items()}
    return {"type": "capture", **{name: getattr(record, name) for name in names}, "cameras": cameras}
