"""Present state of one camera's node, as the controller knows it: connected or not, its status, its processes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ringdic_node.wire import NodeStatus

from ringdic_controller.rig.clocks import NodeTiming
from ringdic_controller.rig.processes import NodeProcesses


@dataclass
class NodePresence:
    """Present state of one camera's node."""

    token: bool = False
    processes: NodeProcesses = field(default_factory=NodeProcesses)
    status: NodeStatus | None = None
    seen_ns: int = 0

    @property
    def alive(self) -> bool:
        """Whether the node, or a process that speaks as it, is connected."""
        return self.token or bool(self.processes)

    def entry(self, camera: str, timing: NodeTiming | None) -> dict[str, Any]:
        """The state of a camera's node as a dictionary of JSON values. timing : what is known of the node's clock."""
        status = self.status
        told = status.detail if status else ""
        return {
            "id": camera,
            "alive": self.alive,
            "state": (status.state if status else "starting") if self.alive else "absent",
            "armed": bool(self.alive and status and status.armed),
            "spool_free": status.spool_free if status else None,
            "spool_images": status.spool_images if status else None,
            "versions": status.versions if status else {},
            "clock_offset_ms": timing.offset_ns / 1e6 if timing else None,
            "clock_error_ms": timing.error_ns / 1e6 if timing else None,
            "last_seen": self.seen_ns / 1e9 if self.seen_ns else None,
            "detail": "; ".join(part for part in (self.processes.contradiction(camera), told) if part),
        }
