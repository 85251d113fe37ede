"""The node's service: it performs what the state machine `Agent` decides, on a camera, a spool and a link.

Three threads: the main loop feeds the agent one event at a time; one thread uses the camera and the disk;
one thread sends images, because sending blocks while the network is busy. Questions for the clock are answered in the
thread that receives them, because the answer is about that moment.
"""

from __future__ import annotations

import logging
import platform
import queue
import threading
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version

import numpy as np
import numpy.typing as npt

from ringdic_node import agent as steps
from ringdic_node.agent import Agent
from ringdic_node.cameras.camera import CameraError, CameraGoneError, Frame, FreeRunningCamera, NodeCamera, Shot
from ringdic_node.clock import STEP_NS, Clock, Instant, RigClock, clock_offset
from ringdic_node.config import NodeConfig
from ringdic_node.identity import Identity
from ringdic_node.image_file import image_digest
from ringdic_node.link import NodeLink
from ringdic_node.room import SpoolRoom
from ringdic_node.spool import Spool, SpoolError
from ringdic_node.wire import (
    Ack,
    Arm,
    ArmReply,
    ClockReading,
    Fetch,
    Keys,
    Manifest,
    NodeStatus,
    Trigger,
    WireError,
    decode_as,
    encode,
    hash_of_settings,
)

log = logging.getLogger(__name__)

PREVIEW_WIDTH = 480
CAMERA_LIMIT_NS = 100_000_000_000  # a camera that works longer, beyond the moment of a capture, hangs


class ServiceError(RuntimeError):
    """The node cannot go on; the text says why. systemd, or whatever started it, should start it again.

    exit_code : 1 for a bug, 3 for a camera that delivers nothing any more.
    """

    def __init__(self, text: str, exit_code: int = 1) -> None:
        super().__init__(text)
        self.exit_code = exit_code


class NodeService:
    """A running node: its state machine joined with camera, spool and link."""

    def __init__(self, config: NodeConfig, camera: NodeCamera, spool: Spool, clock: Clock) -> None:
        self.config = config
        self._camera = camera
        self._spool = spool
        self._clock = clock
        self._events: queue.Queue[steps.Event | Callable[[], None]] = queue.Queue()
        self._camera_work: queue.Queue[steps.LockCamera | steps.TakeFrame | None] = queue.Queue()
        self._parcels: queue.Queue[steps.Publish | steps.AnswerImage | None] = queue.Queue()
        self._stop = threading.Event()
        self._preview: npt.NDArray[np.uint8] | None = None
        # Why this process cannot use its camera any more: as found, and as told to the main loop.
        self._camera_gone = self._camera_fault = ""
        self._camera_began_ns: int | None = None  # when the camera began its present work, by the monotonic clock
        self._offset = clock_offset()
        self._versions = {**_versions(), **camera.versions()}
        self._identity = Identity(config.controller)
        self._locked_to = ""  # hash of the settings that the camera was locked to last; of the camera's thread
        self._room = SpoolRoom(spool, config.id, config.arm_captures)
        self._agent = Agent(
            config.id,
            clock.now(),
            spooled=self._room.waiting,
            delivered=self._room.delivered,
            freed=spool.tombstones(),
            failures=self._room.failures,
            resend_after_ns=round(config.resend_s * 1e9),
        )

    def stop(self) -> None:
        """Ask the main loop to end; may be called from a signal handler or another thread."""
        self._stop.set()

    def run(self) -> None:
        """Serve until stopped. Raises ServiceError if one of its threads has died, or the camera cannot be revived."""
        keys = Keys(self.config.rig)
        config, instance = self.config, self._identity.instance
        self._link = NodeLink(
            keys, config.id, config.controller, self._receive, self._receive_ack, instance, config.certificates
        )
        with self._link:
            workers = [
                threading.Thread(target=self._use_camera, name="camera", daemon=True),
                threading.Thread(target=self._send_images, name="sender", daemon=True),
            ]
            for worker in workers:
                worker.start()
            log.info("node %s of rig %s serves; %d images wait", self.config.id, self.config.rig, self._agent.spooled)
            try:
                self._loop(workers)
            finally:
                self._camera_work.put(None)
                self._parcels.put(None)
        self._camera.close()

    def _loop(self, workers: list[threading.Thread]) -> None:
        published_state: tuple[object, ...] = ()
        next_status = 0
        while not self._stop.is_set():
            try:
                event = self._events.get(timeout=0.1)
            except queue.Empty:
                event = steps.AgentTick()
            if isinstance(event, steps.ArmAsked):
                event = replace(event, obstacle=self._room.obstacle())
            if isinstance(event, steps.Event):
                self._handle(event)
            else:
                event()
            if removed := self._spool.take_removed():
                self._handle(steps.DeliveredRemoved(tuple(removed)))
            now = self._clock.now().monotonic_ns
            state = (self._agent.state, self._agent.spooled)
            if state != published_state or now >= next_status:
                published_state, next_status = state, now + round(self.config.status_s * 1e9)
                self._link.publish_status(self._status())
            self._check(workers)

    def _check(self, workers: list[threading.Thread]) -> None:
        """Raise ServiceError where only a new process helps; what the agent had to tell has been sent."""
        for worker in workers:
            if not worker.is_alive():
                raise ServiceError(f"the node's {worker.name} thread has died; its traceback is above")
        began = self._camera_began_ns
        if began is not None and self._clock.now().monotonic_ns - began > CAMERA_LIMIT_NS:
            self._camera_fault = f"the camera has not returned for {CAMERA_LIMIT_NS / 1e9:.0f} s; it hangs"
        if self._camera_fault and self._events.empty():
            self._link.publish_status(self._status())
            raise ServiceError(f"{self._camera_fault}; the node ends, to be started anew", exit_code=3)

    def _handle(self, event: steps.Event) -> None:
        for action in self._agent.handle(event, self._clock.now()):
            self._perform(action)

    def _status(self) -> NodeStatus:
        return NodeStatus(
            node=self.config.id,
            state=self._agent.state,
            armed=self._agent.armed,
            time_ns=self._clock.now().wall_ns,
            spool_free=self._spool.free,
            spool_images=self._agent.spooled,
            versions=self._versions,
            clock_offset_ms=self._offset[0] if self._offset else None,
            detail="; ".join(each for each in (self._camera_fault, self._room.detail(self._agent.unwanted)) if each),
            **self._identity.fields(),
        )

    # Called from Zenoh's threads: decode and enqueue only

    def _receive(self, verb: str, payload: bytes, question: int) -> None:
        if verb == "clock":
            self._answer_clock(self._clock.now(), question)
            return
        try:
            self._events.put(self._event(verb, payload, question))
        except WireError as error:
            log.warning("a question (%s) breaks the contract: %s", verb, error)
            self._link.decline(question, str(error))

    def _event(self, verb: str, payload: bytes, question: int) -> steps.Event | Callable[[], None]:
        match verb:
            case "arm":
                return steps.ArmAsked(decode_as(Arm, payload), question)
            case "trigger":
                return steps.Triggered(decode_as(Trigger, payload), question)
            case "inventory":
                return steps.InventoryAsked(question)
            case "fetch":
                return steps.FetchAsked(decode_as(Fetch, payload).key, question)
            case "status":
                return lambda: self._link.answer(question, encode(self._status()))
            case "preview":
                return lambda: self._answer_preview(question)
        raise WireError(f"no such question: {verb}")

    def _answer_clock(self, received: Instant, question: int) -> None:
        """Answer at once with the node's clocks, and its newest frame where the sensor runs freely."""
        frame = self._camera.newest_frame() if isinstance(self._camera, FreeRunningCamera) else None
        sent = self._clock.now()
        reading = ClockReading(
            node=self.config.id,
            received_ns=received.monotonic_ns,
            sent_ns=max(sent.monotonic_ns, received.monotonic_ns),
            wall_ns=sent.wall_ns,
            frame_time_ns=frame[0] if frame else None,
            frame_period_ns=frame[1] if frame else None,
        )
        self._link.answer(question, encode(reading))

    def _receive_ack(self, payload: bytes) -> None:
        try:
            self._events.put(steps.Acknowledged(decode_as(Ack, payload)))
        except WireError as error:
            log.warning("an acknowledgement breaks the contract: %s", error)

    # Actions of the state machine

    def _perform(self, action: steps.Action) -> None:
        match action:
            case steps.LockCamera() | steps.TakeFrame():
                self._camera_work.put(action)
            case steps.Publish() | steps.AnswerImage():
                self._parcels.put(action)
            case steps.Free():
                self._spool.deliver(action.key, action.sha256)
            case steps.Report():
                log.error("capture %s failed: %s", action.failure.key, action.failure.reason)
                self._link.publish_status(action.failure)
            case steps.Answer():
                self._link.answer(action.question, encode(action.message))
            case steps.Decline():
                self._link.decline(action.question, action.reason)

    def _answer_preview(self, question: int) -> None:
        if self._preview is None:
            self._link.decline(question, "no frame has been taken yet")
            return
        height, width = self._preview.shape
        self._link.answer(question, f"P5\n{width} {height}\n255\n".encode() + self._preview.tobytes())

    # The camera's thread

    def _use_camera(self) -> None:
        while (work := self._camera_work.get()) is not None:
            ahead_ns = self._ahead_ns(work.trigger) if isinstance(work, steps.TakeFrame) else 0
            self._camera_began_ns = self._clock.now().monotonic_ns + max(ahead_ns, 0)
            self._events.put(self._lock(work) if isinstance(work, steps.LockCamera) else self._take(work.trigger))
            self._camera_began_ns = None
            self._camera_fault = self._camera_gone  # after the event, so that the failure is told before the end

    def _ahead_ns(self, trigger: Trigger) -> int:
        return trigger.key.fire_at_ns - RigClock(trigger.clock_zero_ns).time_ns(self._clock.now())

    def _camera_error(self, error: CameraError) -> str:
        """The camera's complaint; where only a new process can help, the main loop is told."""
        if isinstance(error, CameraGoneError):
            self._camera_gone = str(error)
        return str(error)

    def _lock(self, work: steps.LockCamera) -> steps.Event:
        self._locked_to = ""
        try:
            lock = self._camera.lock(work.settings)
        except CameraError as error:
            return steps.CameraRefused(work.settings_hash, self._camera_error(error))
        self._locked_to = hash_of_settings(work.settings)
        if self._locked_to != work.settings_hash:
            return steps.CameraRefused(
                work.settings_hash, "the hash that came with the settings is not theirs; ask again"
            )
        self._room.image_bytes = lock.image_bytes or self._room.image_bytes
        if obstacle := self._room.obstacle():
            return steps.CameraRefused(work.settings_hash, obstacle)
        self._offset = clock_offset()
        return steps.CameraLocked(
            ArmReply(
                node=self.config.id,
                armed=True,
                settings_hash=work.settings_hash,
                locked=lock.metadata,
                sync=lock.sync,
                clock_offset_ms=self._offset[0] if self._offset else None,
                clock_error_ms=self._offset[1] if self._offset else None,
                frame_time_ns=lock.frame_time_ns,
                frame_period_ns=lock.frame_period_ns,
                spool_free=self._spool.free,
                versions=self._versions,
                **self._identity.fields(),
            )
        )

    def _take(self, trigger: Trigger) -> steps.Event:
        rig_clock = RigClock(trigger.clock_zero_ns)
        offset_ns = rig_clock.offset_ns(self._clock.now())
        shot = Shot(trigger.key.fire_at_ns + offset_ns, trigger.kind, trigger.scene)
        try:
            frame = self._camera.capture(shot)
            parts = frame.pgm()
            timed = replace(frame, time_ns=max(frame.time_ns - offset_ns, 0))
            manifest = make_manifest(self.config.id, trigger, timed, parts, self._locked_to)
            manifest = with_clock(manifest, trigger, offset_ns, rig_clock.offset_ns(self._clock.now()))
            self._spool.store(manifest, parts)
        except CameraError as error:
            return steps.FrameLost(trigger.key, self._camera_error(error))
        except (SpoolError, WireError) as error:
            return steps.FrameLost(trigger.key, str(error))
        self._room.image_bytes = manifest.bytes
        self._preview = preview_image(frame)
        return steps.FrameSpooled(manifest)

    # The sender's thread

    def _send_images(self) -> None:
        while (work := self._parcels.get()) is not None:
            key = work.manifest.key
            try:
                image = self._spool.read(key)
            except SpoolError as error:  # acknowledged and freed since, or the disk is failing
                log.warning("%s", error)
                if isinstance(work, steps.AnswerImage):
                    self._link.decline(work.question, str(error))
            else:
                if isinstance(work, steps.AnswerImage):
                    self._link.answer(work.question, image, work.manifest)
                else:
                    self._link.publish_image(work.manifest, image)
            if isinstance(work, steps.Publish):
                self._events.put(steps.Sent(key))


def make_manifest(
    node: str, trigger: Trigger, frame: Frame, parts: tuple[bytes, bytes], settings_hash: str = ""
) -> Manifest:
    """The manifest of a frame of this node.

    parts : the bytes of its file, header and pixels. settings_hash : of the settings that the camera was locked to.
    """
    sha256, length = image_digest(parts)
    return Manifest(
        node=node,
        key=trigger.key,
        kind=trigger.kind,
        sha256=sha256,
        bytes=length,
        width=frame.width,
        height=frame.height,
        time_ns=frame.time_ns,
        exposure_us=frame.exposure_us,
        metadata=frame.metadata,
        settings_hash=settings_hash,
        row_time_ns=frame.row_time_ns,
    )


def with_clock(manifest: Manifest, trigger: Trigger, offset_ns: int, offset_after_ns: int) -> Manifest:
    """The manifest with what is known of the node's clock, whose offset has been subtracted from the frame's time.

    offset_ns, offset_after_ns : offset of the wall clock from the controller's before and after the frame, ns. A clock
    that was set in between leaves the frame's time uncertain by that much; one that was set since the node was armed
    is noted.
    """
    if trigger.clock_zero_ns is None or trigger.clock_offset_ns is None:
        return manifest
    during, since = offset_after_ns - offset_ns, offset_after_ns - trigger.clock_offset_ns
    if abs(since) > STEP_NS:
        log.warning("the clock was set by %+.1f ms between arming and capture %s", since / 1e6, manifest.key)
    return replace(
        manifest,
        clock_offset_ns=offset_ns,
        clock_error_ns=(trigger.clock_error_ns or 0) + (abs(during) if abs(during) > STEP_NS else 0),
        clock_step_ns=since if abs(since) > STEP_NS else 0,
    )


def preview_image(frame: Frame) -> npt.NDArray[np.uint8]:
    """A small picture of a frame: every n-th pixel, (height, width) 8-bit grey levels, at most `PREVIEW_WIDTH` wide."""
    stride = -(-frame.width // PREVIEW_WIDTH)
    small = frame.pixels[::stride, ::stride]
    shift = 8 if small.dtype == np.uint16 else 0
    return np.ascontiguousarray((small >> shift).astype(np.uint8))


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for package in ("ringdic", "eclipse-zenoh"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed as a package"
    return versions
