"""What remains after the chaos: every image that a node had stored is archived once, everything else has its reason."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ringdic.session.records import CaptureRecord
from ringdic.session.verification import verify_session
from ringdic.session.writer import SessionWriter


@dataclass(frozen=True)
class ChaosAudit:
    """Figures of a session and of the spools of its nodes.

    captures, images : archived captures and images, conflicting ones included. spooled : images that the nodes' spools
    have had. late, conflicts : of the archived images. named : cameras of captures without an image, by reason.
    faults : a sentence for each thing that must not be; empty where all is well.
    """

    captures: int
    images: int
    spooled: int
    late: int
    conflicts: int
    named: dict[str, int]
    faults: tuple[str, ...]


def waiting_images(spool: Path) -> list[str]:
    """Names of the manifests in a node's spool whose images are not known as delivered."""
    manifests = [path for path in spool.glob("*.json") if not path.name.startswith(".")]
    return sorted(path.name for path in manifests if not path.with_suffix(".freed").exists())


def audit_session(session: SessionWriter, spools: Sequence[Path]) -> ChaosAudit:
    """Compare the archive with what the nodes still hold; their spools must be large enough to have kept all images."""
    verified = verify_session(session.path)
    records = session.captures()
    faults = [*verified.faults.values(), *verified.notes, *_unclosed(records)]
    archived: Counter[tuple[str, str, str]] = Counter()
    for record in records:
        for camera, entry in record.cameras.items():
            hashes = [entry.sha256] if entry.sha256 else []
            archived.update((record.capture_id, camera, sha256) for sha256 in [*hashes, *entry.conflicts.values()])
    spooled = [manifest for spool in spools for manifest in _manifests(spool)]
    for capture_id, camera, sha256 in spooled:
        times = archived[capture_id, camera, sha256]
        if times != 1:
            faults.append(f"the image of {camera} in {capture_id} is archived {times} times")
    for folder in (session.path, *spools):
        faults += [f"{path}: left behind" for path in folder.rglob(".partial-*")]
    for spool in spools:
        faults += [f"{spool / name}: not delivered" for name in waiting_images(spool)]
        faults += [f"{path}: an image without a manifest" for path in spool.glob("aside/*.pgm")]
    entries = [entry for record in records for entry in record.cameras.values()]
    return ChaosAudit(
        captures=len(records),
        images=sum(archived.values()),
        spooled=len(spooled),
        late=sum(entry.status not in ("ok", "failed") for entry in entries),
        conflicts=sum(len(entry.conflicts) for entry in entries),
        named=dict(Counter(_kind_of(entry.reason) for entry in entries if entry.status == "failed").most_common()),
        faults=tuple(faults),
    )


def _manifests(spool: Path) -> list[tuple[str, str, str]]:
    """Capture, camera and checksum of all images in a spool."""
    documents = [json.loads(path.read_bytes()) for path in spool.glob("*.json") if not path.name.startswith(".")]
    return [(each["key"]["capture_id"], each["node"], each["sha256"]) for each in documents]


def _unclosed(records: Sequence[CaptureRecord]) -> list[str]:
    faults = [f"{record.capture_id} is not closed" for record in records if record.state != "closed"]
    for record in records:
        for camera, entry in record.cameras.items():
            if entry.status == "pending" or (entry.status == "failed" and not entry.reason):
                faults.append(f"{record.capture_id}: camera {camera} is {entry.status} without a reason")
    return faults


def _kind_of(reason: str | None) -> str:
    """A reason without what differs from case to case: its beginning, with "…" for words that have digits."""
    return re.sub(r"\S*\d\S*", "…", (reason or "").split(":")[0].split(" (")[0])[:70]
