"""Present state of one camera's node, as the controller knows it: connected or not, its status, its processes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ringdic_node.wire import NodeStatus

from ringdic_controller.rig.processes import NodeProcesses


@dataclass
class NodePresence:
    """Present state of one camera's node."""

    token: bool = False
    processes: NodeProcesses = field(default_factory=NodeProcesses)
    status: NodeStatus | None = None
    seen_ns: int = 0
    offset_ms: float | None = None
    quickest_ns: int = 0

    @property
    def alive(self) -> bool:
        """Whether the node, or a process that speaks as it, is connected."""
        return self.token or bool(self.processes)

    def note_offset(self, round_trip_ns: int, offset_ns: int) -> None:
        """Take over the node's clock offset, ns, if its round trip, ns, was quick: half of that bounds the error."""
        if self.offset_ms is None or round_trip_ns <= 1.5 * self.quickest_ns:
            self.offset_ms = offset_ns / 1e6
            self.quickest_ns = min(round_trip_ns, self.quickest_ns or round_trip_ns)

    def entry(self, camera: str) -> dict[str, Any]:
        """The state of a camera's node as a dictionary of JSON values."""
        status = self.status
        own = status.clock_offset_ms if status else None
        told = status.detail if status else ""
        return {
            "id": camera,
            "alive": self.alive,
            "state": (status.state if status else "starting") if self.alive else "absent",
            "armed": bool(self.alive and status and status.armed),
            "spool_free": status.spool_free if status else None,
            "spool_images": status.spool_images if status else None,
            "versions": status.versions if status else {},
            "clock_offset_ms": own if own is not None else self.offset_ms,
            "last_seen": self.seen_ns / 1e9 if self.seen_ns else None,
            "detail": "; ".join(part for part in (self.processes.contradiction(camera), told) if part),
        }
