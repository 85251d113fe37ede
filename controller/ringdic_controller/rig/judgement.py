"""Decision whether an image that arrives is archived. Standard library only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ringdic_node.wire import Manifest


@dataclass(frozen=True)
class Judgement:
    """Decision about an image: ``verdict`` archive, repeat (archived before), unknown (no such capture) or corrupt."""

    verdict: str
    reason: str = ""


def judge(
    manifest: Manifest, sha256: str, length: int, fire_at_ns: int | None, archived: Mapping[str, str | None]
) -> Judgement:
    """Decide whether to archive one image, from its manifest, the bytes that arrived, and the archive's record.

    Parameters
    ----------
    manifest
        What the node says about the image.
    sha256, length
        Hash and number of the bytes that arrived.
    fire_at_ns
        Planned moment in the archive's record; None if the archive has no such capture.
    archived
        For each expected camera of the record, the hash of its archived image or None.
    """
    if sha256 != manifest.sha256 or length != manifest.bytes:
        return Judgement("corrupt", f"{length} bytes with another checksum than the {manifest.bytes} promised")
    if fire_at_ns is None or fire_at_ns != manifest.key.fire_at_ns:
        return Judgement("unknown", f"no capture {manifest.key} was made here at that moment")
    if manifest.node not in archived:
        return Judgement("unknown", f"camera {manifest.node} is not in capture {manifest.key}")
    if archived[manifest.node] == sha256:
        return Judgement("repeat")
    return Judgement("archive")
