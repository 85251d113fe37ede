"""Intake of images from the network into the archive: they are queued, checked, stored and acknowledged.

An image is acknowledged only after it is durable in the archive under its own checksum. An image that is not
acknowledged stays with its node and is sent again, so the intake may drop any image.
"""

from __future__ import annotations

import hashlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

from ringdic.session.records import ImageDescription
from ringdic.session.writer import Archive
from ringdic_node.wire import CaptureKey, Failure, Manifest

from ringdic_controller.rig.judgement import judge
from ringdic_controller.rig.rounds import capture_event

log = logging.getLogger(__name__)

INBOX_BYTES = 512 << 20
ARCHIVISTS = 4  # threads: one waits for the disk while another computes a checksum

_Image = tuple[str, CaptureKey, str]  # node, capture, SHA-256


class Intake:
    """A bounded queue of images and the threads that archive them.

    All callbacks are called with no lock held.

    Parameters
    ----------
    archive
        Receives the images.
    acknowledge : callable (manifest, verdict)
        Sends an acknowledgement to the node: ``archived`` or ``unknown``.
    on_archived : callable (manifest)
        Called after every image that is durable in the archive, repeats included.
    on_event : callable (dict)
        Called with `capture_event` when a capture's record has changed.
    limit
        Bytes that may wait; an image beyond it is dropped, and pulled from its node later.
    """

    def __init__(
        self,
        archive: Archive,
        acknowledge: Callable[[Manifest, str], None],
        on_archived: Callable[[Manifest], None],
        on_event: Callable[[dict[str, Any]], None],
        *,
        limit: int = INBOX_BYTES,
    ) -> None:
        self._archive = archive
        self._acknowledge = acknowledge
        self._on_archived = on_archived
        self._on_event = on_event
        self._limit = limit
        self._lock = threading.Lock()  # guards the two below
        self._waiting_bytes = 0
        self._waiting: set[_Image] = set()
        self._inbox: queue.Queue[tuple[Manifest, bytes] | None] = queue.Queue()
        self._threads = [
            threading.Thread(target=self._work, name=f"archivist-{k}", daemon=True) for k in range(ARCHIVISTS)
        ]

    def start(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def stop(self, timeout: float) -> None:
        """Archive what has arrived, then end the threads; wait at most ``timeout`` seconds for them."""
        deadline = time.monotonic() + timeout
        for _ in self._threads:
            self._inbox.put(None)
        for thread in self._threads:
            thread.join(max(deadline - time.monotonic(), 0.0))

    def has_room(self, size: int) -> bool:
        """Whether an image of ``size`` bytes would be queued."""
        with self._lock:
            return self._waiting_bytes + size <= self._limit

    def holds(self, manifest: Manifest) -> bool:
        """Whether the image waits in the queue already, because it was sent twice, or pulled while it was pushed."""
        with self._lock:
            return _image(manifest) in self._waiting

    def put(self, manifest: Manifest, image: bytes) -> bool:
        """Queue an image, unless it waits already; returns at once, False if there was no room."""
        with self._lock:
            if _image(manifest) in self._waiting:
                return True
            if self._waiting_bytes + len(image) > self._limit:
                log.warning("the inbox is full; the image of %s from %s will be pulled", manifest.key, manifest.node)
                return False
            self._waiting_bytes += len(image)
            self._waiting.add(_image(manifest))
        self._inbox.put((manifest, image))
        return True

    def _work(self) -> None:
        """Archive one image after the other, until the inbox is closed."""
        while (entry := self._inbox.get()) is not None:
            manifest, image = entry
            try:
                self.take(manifest, image)
            except (OSError, ValueError) as error:  # a full disk, a damaged record: the node keeps the image
                log.error("the image of %s from %s is not archived: %s", manifest.key, manifest.node, error)
            except Exception:
                log.exception("after the image of %s from %s", manifest.key, manifest.node)
            finally:
                with self._lock:
                    self._waiting_bytes -= len(image)
                    self._waiting.discard(_image(manifest))
                del entry, image  # not held until the next one comes

    def take(self, manifest: Manifest, image: bytes) -> None:
        """Check one image, archive it and acknowledge it; acknowledge it as ``unknown`` if no capture expects it."""
        capture = self._archive.capture(manifest.key.session, manifest.key.capture_id)
        record = capture.record() if capture else None
        sha256 = hashlib.sha256(image).hexdigest()
        judgement = judge(
            manifest,
            sha256,
            len(image),
            record.fire_at_ns if record else None,
            {camera: entry.archived_as(sha256) for camera, entry in record.cameras.items()} if record else {},
        )
        if judgement.verdict == "corrupt":
            log.error("image of %s from %s refused: %s", manifest.key, manifest.node, judgement.reason)
            return
        if judgement.verdict == "unknown" or capture is None:
            log.warning("image from %s is not wanted: %s", manifest.node, judgement.reason)
            self._acknowledge(manifest, "unknown")
            return
        new = judgement.verdict == "archive"
        if new:
            stored = capture.store(manifest.node, description_of(manifest), image, sha256=sha256)
            if stored.verdict == "conflict":
                log.error("%s: %s", manifest.key, capture.record().cameras[manifest.node].reason)
        self._acknowledge(manifest, "archived")
        self._on_archived(manifest)
        if new:  # last: whoever watches must not keep the node waiting
            self._on_event(capture_event(capture.record()))

    def wants(self, manifest: Manifest, *, delivered: bool = False) -> bool:
        """Whether an image that a node holds should be pulled; acknowledges it if it is archived already.

        delivered : whether the node has had an acknowledgement, which may have come from somebody else.
        """
        capture = self._archive.capture(manifest.key.session, manifest.key.capture_id)
        if capture is None:
            return False
        record = capture.record()
        if record.fire_at_ns != manifest.key.fire_at_ns or manifest.node not in record.cameras:
            return False
        if record.cameras[manifest.node].archived_as(manifest.sha256) == manifest.sha256:
            if not delivered:
                self._acknowledge(manifest, "archived")  # the first acknowledgement was lost
            return False
        # While a capture is open, its round pulls the images; a second transfer would compete with that.
        return record.state == "closed"

    def note_failure(self, failure: Failure) -> None:
        """Replace the general reason of a failed camera in a closed capture's record by the one that its node gives."""
        capture = self._archive.capture(failure.key.session, failure.key.capture_id)
        if capture is None:
            return
        record = capture.record()
        entry = record.cameras.get(failure.node)
        if record.fire_at_ns != failure.key.fire_at_ns or entry is None or entry.status != "failed":
            return
        if entry.reason != failure.reason:
            capture.fail(failure.node, failure.reason)
            self._on_event(capture_event(capture.record()))


def description_of(manifest: Manifest) -> ImageDescription:
    """The part of a node's manifest that the record keeps: checksum, size, time, exposure, clock, metadata."""
    return ImageDescription(
        manifest.sha256,
        manifest.width,
        manifest.height,
        manifest.time_ns,
        manifest.exposure_us,
        manifest.metadata,
        manifest.format,
        manifest.settings_hash or None,
        manifest.clock_offset_ns,
        manifest.clock_error_ns,
        manifest.clock_step_ns,
        manifest.row_time_ns,
    )


def _image(manifest: Manifest) -> _Image:
    return manifest.node, manifest.key, manifest.sha256
