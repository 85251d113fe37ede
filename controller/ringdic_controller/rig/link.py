"""Link to the rig's nodes over Zenoh: their states, capture rounds, images, and reconciliation.

This is the controller's only contact with Zenoh. The router runs inside this process, and the nodes connect to it.
Zenoh's callbacks only queue what they receive; the intake archives images in threads of its own. Another thread asks
the nodes, when they appear and at an interval, which images they still hold.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import zenoh
from ringdic.errors import ComputationError, InputError
from ringdic.session.records import CaptureRecord
from ringdic.session.writer import Archive, CaptureWriter, SessionWriter
from ringdic_node.endpoint import EndpointError
from ringdic_node.wire import (
    Ack,
    Arm,
    ArmReply,
    CaptureKey,
    ClockReading,
    Failure,
    Fetch,
    Inventory,
    Keys,
    Manifest,
    NodeStatus,
    Trigger,
    TriggerReply,
    WireError,
    decode,
    decode_as,
    encode,
)

from ringdic_controller.rig import capture as steps
from ringdic_controller.rig.capture import Timing
from ringdic_controller.rig.clock_watch import ARM_EXCHANGES, TIMEOUT, ClockWatch
from ringdic_controller.rig.clocks import NodeTiming, wall_start_ns
from ringdic_controller.rig.intake import Intake
from ringdic_controller.rig.presence import NodePresence
from ringdic_controller.rig.replies import decoded
from ringdic_controller.rig.rounds import run_round
from ringdic_controller.rig.router import router_config
from ringdic_controller.rig.unclosed import UnclosedCaptures
from ringdic_controller.rig.visits import NodeVisits

log = logging.getLogger(__name__)

INVENTORY_TIMEOUT = 5.0
FETCH_TIMEOUT = 30.0


class RigBusyError(ComputationError):
    """A capture is under way already."""


class RigLink:
    """Link to the nodes of a rig; a context manager that listens for them.

    Parameters
    ----------
    rig_name
        Name of the rig, which nodes and controller have in common.
    cameras
        Ids of the expected cameras, in ring order.
    endpoint
        Where nodes connect, like ``tls/0.0.0.0:7447``; the port must be a definite one.
    archive
        Receives the captures.
    on_event : callable (dict)
        Called when a node (``type`` node) or a capture (``type`` capture) has changed, from several threads and with
        no lock held.
    timing
        Waits of a capture round; None for the usual ones.
    tolerance_ns
        Largest skew of a capture that is not flagged, ns.
    reconcile_s
        Interval at which nodes are asked which images they hold, s.
    certificates
        Folder of the controller's certificate, for an endpoint ``tls/…``: then a node needs one too, and may speak only
        for itself. Only an endpoint on loopback does without.
    """

    def __init__(
        self,
        rig_name: str,
        cameras: list[str],
        endpoint: str,
        archive: Archive,
        on_event: Callable[[dict[str, Any]], None],
        *,
        timing: Timing | None = None,
        tolerance_ns: int = 1_000_000,
        reconcile_s: float = 10.0,
        certificates: Path | None = None,
    ) -> None:
        self.cameras = list(cameras)
        self._keys = Keys(rig_name)
        self._endpoint = endpoint
        self._certificates = certificates
        self._archive = archive
        self._on_event = on_event
        self._timing = timing or Timing()
        self._tolerance_ns = tolerance_ns
        self._lock = threading.Lock()  # guards the two below
        self._nodes = {camera: NodePresence() for camera in self.cameras}
        self._round_events: queue.Queue[steps.Event] | None = None  # of the capture that is under way
        self._intake = Intake(
            archive, self._acknowledge, lambda manifest: self._pass_to_round(steps.ImageArchived(manifest)), on_event
        )
        self._unclosed = UnclosedCaptures(on_event)
        self._visits = NodeVisits(self._visit, self._alive, self._unclosed.close, reconcile_s)
        self._clocks = ClockWatch(self.cameras, self._ask_clock, self._alive, tolerance_ns)

    def __enter__(self) -> RigLink:
        for name in self._archive.close_unfinished("the controller was restarted before the image arrived"):
            log.warning("capture %s was left open by an earlier run and is closed", name)
        try:
            self._session = zenoh.open(router_config(self._endpoint, self._keys.rig, self.cameras, self._certificates))
        except EndpointError as error:
            raise InputError(str(error)) from error
        except zenoh.ZError as error:
            reason = str(error).split(" at /")[0].lstrip("[")
            raise InputError(
                f"the controller cannot listen on '{self._endpoint}' ({reason}); "
                "choose another endpoint, or end the program that uses it"
            ) from error
        keys = self._keys
        self._subscribers = [
            self._session.declare_subscriber(keys.image("*"), self._receive_image),
            self._session.declare_subscriber(keys.node("*", "status"), self._receive_status),
            self._session.liveliness().declare_subscriber(keys.alive("*"), self._receive_alive, history=True),
            self._session.liveliness().declare_subscriber(
                keys.instance("*", "*"), self._receive_instance, history=True
            ),
        ]
        self._intake.start()
        self._visits.start()
        self._clocks.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._visits.end()
        self._intake.stop(timeout=INVENTORY_TIMEOUT)
        self._visits.join(timeout=INVENTORY_TIMEOUT)
        self._clocks.end(timeout=INVENTORY_TIMEOUT)
        self._unclosed.close()
        self._session.close()

    # The roster

    def roster(self) -> list[dict[str, Any]]:
        """One dictionary for each expected camera, in ring order, with the present state of its node."""
        with self._lock:
            return [node.entry(camera, self._timing_now(camera)) for camera, node in self._nodes.items()]

    def _timing_now(self, camera: str) -> NodeTiming | None:
        return self._clocks.timing(camera, wall_start_ns())

    def _alive(self) -> list[str]:
        with self._lock:
            return [camera for camera, node in self._nodes.items() if node.alive]

    def wait_for_nodes(self, timeout: float) -> list[str]:
        """Wait until every expected node is alive, at most ``timeout`` seconds; ids of those that are not."""
        deadline = time.monotonic() + timeout
        while len(alive := self._alive()) < len(self.cameras) and time.monotonic() < deadline:
            time.sleep(0.05)
        return [camera for camera in self.cameras if camera not in alive]

    def preview(self, camera: str, timeout: float = 3.0) -> bytes | None:
        """The camera's newest frame as a small PGM (bytes); None if no answer comes within ``timeout`` seconds."""
        for reply in self._session.get(self._keys.node(camera, "preview"), timeout=timeout):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
        return None

    def _receive_alive(self, sample: zenoh.Sample) -> None:
        camera = str(sample.key_expr).rsplit("/", 1)[1]
        alive = sample.kind == zenoh.SampleKind.PUT
        self._note_presence(camera, lambda node: setattr(node, "token", alive))

    def _receive_instance(self, sample: zenoh.Sample) -> None:
        camera, instance = str(sample.key_expr).split("/")[-2:]
        if sample.kind == zenoh.SampleKind.PUT:
            self._note_presence(camera, lambda node: node.processes.appeared(instance, time.monotonic_ns()))
            self._visits.ask_for(camera)  # whoever else speaks as this node is heard then
        else:
            self._note_presence(camera, lambda node: node.processes.gone(instance))

    def _note_presence(self, camera: str, change: Callable[[NodePresence], None]) -> None:
        """Change what is known of a node's presence, and report what follows from it."""
        with self._lock:
            node = self._nodes.get(camera)
            if node is None:
                return
            before, contradiction = node.alive, node.processes.contradiction(camera)
            change(node)
            alive, contradicts = node.alive, node.processes.contradiction(camera)
            if alive != before:
                node.seen_ns = time.time_ns()
            entry = node.entry(camera, self._timing_now(camera))
        if alive != before:
            log.info("node %s %s", camera, "appeared" if alive else "disappeared")
            self._pass_to_round(steps.NodeBack(camera) if alive else steps.NodeGone(camera))
            if alive:
                self._visits.ask_for(camera)
        if contradicts != contradiction:
            log.error("node %s: %s", camera, contradicts or "there is one of this id again")
            self._pass_to_round(steps.NodeDoubled(camera, contradicts))
        if (alive, contradicts) != (before, contradiction):
            self._on_event({"type": "node", "node": entry})

    def _note_heard(self, message: NodeStatus | ArmReply) -> None:
        instance, host, address, now = message.instance, message.host, message.address, time.monotonic_ns()
        self._note_presence(message.node, lambda node: node.processes.heard(instance, host, address, now))

    def _receive_status(self, sample: zenoh.Sample) -> None:
        try:
            message = decode(sample.payload.to_bytes())
        except WireError as error:
            log.warning("a status on %s breaks the contract: %s", sample.key_expr, error)
            return
        if not isinstance(message, Failure | NodeStatus) or not _speaks_for_itself(message, sample, -2):
            return
        if isinstance(message, Failure):
            self._pass_to_round(steps.FailureReported(message))
        else:
            self._note_status(message)

    def _note_status(self, status: NodeStatus) -> None:
        self._note_heard(status)
        with self._lock:
            node = self._nodes.get(status.node)
            if node is None:
                return
            before = node.entry(status.node, self._timing_now(status.node))
            node.status, node.seen_ns = status, time.time_ns()
            entry = node.entry(status.node, self._timing_now(status.node))
        shown = ("alive", "state", "armed", "spool_images", "detail")
        if any(before[name] != entry[name] for name in shown):
            self._on_event({"type": "node", "node": entry})

    # Images

    def _receive_image(self, sample: zenoh.Sample) -> None:
        try:
            manifest = decode_as(Manifest, sample.attachment.to_bytes() if sample.attachment else b"")
        except WireError as error:
            log.warning("an image on %s has no usable manifest: %s", sample.key_expr, error)
            return
        if not _speaks_for_itself(manifest, sample, -1):
            return
        if self._intake.has_room(len(sample.payload)) and not self._intake.holds(manifest):
            self._intake.put(manifest, sample.payload.to_bytes())

    def _acknowledge(self, manifest: Manifest, verdict: str) -> None:
        ack = Ack(manifest.node, manifest.key, manifest.sha256, verdict)
        try:
            self._session.put(
                self._keys.node(manifest.node, "ack"),
                encode(ack),
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
            )
        except zenoh.ZError as error:  # the node sends its image again, and is answered again
            log.warning("an acknowledgement to %s could not be sent: %s", manifest.node, error)

    # Reconciliation

    def _visit(self, camera: str) -> None:
        """Reconcile one node; an error with it is logged, so that the others have their turn."""
        try:
            self._reconcile_node(camera)
        except (OSError, ValueError, zenoh.ZError) as error:
            if not self._visits.stopped:
                log.error("node %s could not be reconciled: %s", camera, error)

    def _reconcile_node(self, camera: str) -> None:
        """Ask one node for its status and its inventory; pull the images that the archive lacks."""
        for status in self._answers(camera, "status", NodeStatus):
            self._note_status(status)
        for inventory in self._answers(camera, "inventory", Inventory):
            for failure in inventory.failures:
                self._attempt(failure.key, self._intake.note_failure, failure)
            for manifest in inventory.manifests:
                self._attempt(manifest.key, self._pull, manifest, False)
            for manifest in inventory.delivered:
                self._attempt(manifest.key, self._pull, manifest, True)

    @staticmethod
    def _attempt(key: CaptureKey, act: Callable[..., None], *arguments: Any) -> None:
        """Do something for one capture; what is wrong with its record must not keep the others from their turn."""
        try:
            act(*arguments)
        except (OSError, ValueError) as error:
            log.error("capture %s could not be reconciled: %s", key, error)

    def _pull(self, manifest: Manifest, delivered: bool) -> None:
        """Fetch an image if the archive lacks it. delivered : whether its node was told that the archive has it."""
        if not self._intake.wants(manifest, delivered=delivered):
            return
        if delivered:
            log.error(
                "node %s was told that %s is archived, which it is not: somebody else acknowledges images on this "
                "network, or the archive has lost it; it is fetched from the node",
                manifest.node,
                manifest.key,
            )
        self.fetch(manifest)

    def fetch(self, manifest: Manifest) -> None:
        """Pull an image that a node holds; it enters the intake like a pushed one. Returns at once."""
        if self._intake.holds(manifest):
            return

        def receive(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._intake.put(manifest, reply.ok.payload.to_bytes())
            elif reply.err is not None:
                log.warning("node %s does not give %s: %s", manifest.node, manifest.key, reply.err.payload.to_string())

        self._session.get(
            self._keys.node(manifest.node, "fetch"),
            receive,
            payload=encode(Fetch(manifest.key)),
            timeout=FETCH_TIMEOUT,
            priority=zenoh.Priority.DATA,
        )

    def _answers(self, camera: str, verb: str, answer: type[Any]) -> Iterator[Any]:
        replies = self._session.get(
            self._keys.node(camera, verb),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=INVENTORY_TIMEOUT,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
        )
        for reply in replies:
            message = decoded(reply, answer)
            if message is not None and message.node == camera:
                yield message

    # Clocks

    def timing(self, camera: str, start_ns: int) -> NodeTiming | None:
        """What is known of a node's clock and frames, as `ClockWatch.timing` describes."""
        return self._clocks.timing(camera, start_ns)

    def _ask_clock(self, camera: str, on_answer: Callable[[ClockReading | None], None]) -> None:
        """Ask a node for its clock; ``on_answer`` is called from Zenoh's thread, or never."""
        try:
            self._session.get(
                self._keys.node(camera, "clock"),
                lambda reply: on_answer(decoded(reply, ClockReading)),
                timeout=TIMEOUT,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
        except zenoh.ZError as error:
            log.warning("node %s could not be asked for its clock: %s", camera, error)

    # Captures

    def capture(
        self,
        session: SessionWriter,
        kind: str,
        *,
        override: bool = False,
        settings: dict[str, Any] | None = None,
    ) -> CaptureRecord:
        """Capture one image with every camera; return the closed record.

        Blocks until the round closes, at most the sum of its waits.

        Parameters
        ----------
        session, kind
            Writer of the session that the images go to, and kind of the capture.
        override
            Fire although cameras are not armed.
        settings
            Camera settings that the cameras are locked to; None for the ``[capture]`` table of the session's rig.toml.

        Raises
        ------
        CaptureRefusedError
            Not every camera is armed and ``override`` is not given, or none is armed.
        RigBusyError
            Another capture is under way.
        """
        events: queue.Queue[steps.Event] = queue.Queue()
        with self._lock:
            if self._round_events is not None:
                raise RigBusyError("a capture is under way; wait until it has closed")
            self._round_events = events
            absent = [camera for camera, node in self._nodes.items() if not node.alive]
            doubled = {camera: node.processes.contradiction(camera) for camera, node in self._nodes.items()}
        try:
            return run_round(
                self,
                events,
                session,
                kind,
                cameras=self.cameras,
                absent=absent,
                doubled=doubled,
                timing=self._timing,
                tolerance_ns=self._tolerance_ns,
                override=override,
                settings=session.camera_settings if settings is None else settings,
                on_event=self._on_event,
            )
        finally:
            with self._lock:
                self._round_events = None

    def close_later(self, writer: CaptureWriter, reasons: Mapping[str, str]) -> None:
        """Close a capture's record, which the disk did not take, at the next reconciliation, or the one after it."""
        self._unclosed.add(writer, reasons)

    def _pass_to_round(self, event: steps.Event) -> None:
        """Hand an event to the capture that is under way, if there is one."""
        with self._lock:
            events = self._round_events
        if events is not None:
            events.put(event)

    def ask(
        self, camera: str, question: Arm | Trigger | None, on_answer: Callable[[Any], None], timeout: float
    ) -> None:
        """Ask one node to arm, to capture or, with None, for its inventory; returns at once.

        ``on_answer`` is called from Zenoh's thread with a well-formed answer within ``timeout`` seconds, or never.
        """
        if isinstance(question, Arm):  # its clock is measured first, since it is a condition of arming
            threading.Thread(
                target=self._arm, args=(camera, question, on_answer, timeout), name=f"arm-{camera}", daemon=True
            ).start()
        else:
            self._ask(camera, question, on_answer, timeout)

    def _arm(self, camera: str, question: Arm, on_answer: Callable[[Any], None], timeout: float) -> None:
        try:
            self._clocks.measure(camera, ARM_EXCHANGES)
            self._ask(camera, question, on_answer, timeout)
        except zenoh.ZError as error:
            log.warning("node %s could not be asked to arm: %s", camera, error)

    def _ask(
        self, camera: str, question: Arm | Trigger | None, on_answer: Callable[[Any], None], timeout: float
    ) -> None:
        verb, answer = ("inventory", Inventory) if question is None else _ANSWERS[type(question)]

        def receive(reply: zenoh.Reply) -> None:
            message = decoded(reply, answer)
            if message is not None and message.node == camera:
                if isinstance(message, ArmReply):
                    self._note_heard(message)
                on_answer(message)

        urgent = isinstance(question, Trigger)
        self._session.get(
            self._keys.node(camera, verb),
            receive,
            payload=encode(question) if question is not None else b"",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
            priority=zenoh.Priority.REAL_TIME if urgent else zenoh.Priority.INTERACTIVE_HIGH,
            express=urgent,
        )


_ANSWERS: dict[type[Any], tuple[str, type[Any]]] = {Arm: ("arm", ArmReply), Trigger: ("trigger", TriggerReply)}


def _speaks_for_itself(message: Failure | NodeStatus | Manifest, sample: zenoh.Sample, place: int) -> bool:
    """Whether the node in a message is the one in its key, at `place` of its parts; a line in the log if not."""
    if str(sample.key_expr).split("/")[place] == message.node:
        return True
    log.error("a message on %s speaks for node %s and is ignored", sample.key_expr, message.node)
    return False
