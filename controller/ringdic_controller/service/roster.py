"""The rig as the operator sees it: the cameras of rig.toml with the state of their nodes."""

from __future__ import annotations

from typing import Any, Protocol

from ringdic.session.records import CaptureRecord
from ringdic.session.rig import Rig, parse_rig

_UNKNOWN = {"alive": False, "armed": False, "state": "unknown"}


class CameraNodes(Protocol):
    """The nodes of the rig's cameras: `ringdic_controller.rig.link.RigLink`, or a stand-in."""

    def roster(self) -> list[dict[str, Any]]:
        """One dictionary for each camera: id, alive, state, armed, spool_free, spool_images, versions, …"""

    def capture(self, session: Any, kind: str, *, override: bool = False) -> CaptureRecord:
        """Capture with every camera into a session's writer; blocks until the capture closes; its record."""


class NodeRoster:
    """Cameras of the rig and, once they are connected, their nodes.

    Parameters
    ----------
    rig_toml
        The rig as TOML text; None for a controller without a rig. Raises InputError if the text is no rig.
    """

    def __init__(self, rig_toml: str | None) -> None:
        self.rig_toml = rig_toml
        self.rig: Rig | None = parse_rig(rig_toml) if rig_toml else None
        self.nodes: CameraNodes | None = None  # replaced as a whole when they connect: needs no lock

    def cameras(self) -> list[dict[str, Any]]:
        """One dictionary for each camera in ring order: id, azimuth_deg, and the state of its node."""
        states = {node["id"]: node for node in self.nodes.roster()} if self.nodes else {}
        if self.rig is None:
            return list(states.values())
        return [
            {**_UNKNOWN, **states.get(camera.id, {}), "id": camera.id, "azimuth_deg": camera.azimuth_deg}
            for camera in self.rig.cameras
        ]

    def missing(self) -> list[str]:
        """Ids of the cameras whose node is not alive."""
        return [camera["id"] for camera in self.cameras() if not camera.get("alive")]
