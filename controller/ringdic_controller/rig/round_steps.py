"""Events and actions of a capture round, about which `ringdic_controller.rig.capture` decides. Stdlib only."""

from __future__ import annotations

from dataclasses import dataclass

from ringdic_node.wire import ArmReply, CaptureKey, Failure, Inventory, Manifest, TriggerReply

from ringdic_controller.rig.clocks import NodeTiming
from ringdic_controller.rig.frame_grid import FrameGrid

# Events ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ArmAnswered:
    """A node has answered whether its camera is armed. timing : of its clock; None where that was not measured."""

    reply: ArmReply
    timing: NodeTiming | None = None


@dataclass(frozen=True)
class CaptureOpened:
    """The archive has created the capture's folder and record."""

    key: CaptureKey


@dataclass(frozen=True)
class TriggerAnswered:
    """A node has accepted or rejected the trigger."""

    reply: TriggerReply


@dataclass(frozen=True)
class ImageArchived:
    """An image is durable in the archive."""

    manifest: Manifest


@dataclass(frozen=True)
class FailureReported:
    """A node has reported that it took no image, and why."""

    failure: Failure


@dataclass(frozen=True)
class InventoryAnswered:
    """A node has listed the images and failures that it holds."""

    inventory: Inventory


@dataclass(frozen=True)
class NodeGone:
    """A camera's node has lost its connection."""

    camera: str


@dataclass(frozen=True)
class NodeBack:
    """A camera's node is connected again."""

    camera: str


@dataclass(frozen=True)
class NodeDoubled:
    """Two processes speak as one camera's node, or no longer: `reason` says which; empty if it is one again."""

    camera: str
    reason: str


@dataclass(frozen=True)
class RoundTick:
    """Time has passed."""


Event = (
    ArmAnswered
    | CaptureOpened
    | TriggerAnswered
    | ImageArchived
    | FailureReported
    | InventoryAnswered
    | NodeGone
    | NodeBack
    | NodeDoubled
    | RoundTick
)


# Actions -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SendArm:
    """Ask nodes to arm their cameras; answers come back as ArmAnswered."""

    cameras: tuple[str, ...]


@dataclass(frozen=True)
class OpenCapture:
    """Create the capture's record; CaptureOpened follows.

    unarmed : by camera, why it takes no part. armed : by camera, what it answered when it armed. grid : the frame grid
    that the moment lies on, if sensors run freely.
    """

    fire_at_ns: int
    unarmed: dict[str, str]
    armed: dict[str, ArmReply]
    grid: FrameGrid | None = None


@dataclass(frozen=True)
class SendTrigger:
    """Ask nodes to capture at the key's planned moment; answers come back as TriggerAnswered."""

    cameras: tuple[str, ...]
    key: CaptureKey


@dataclass(frozen=True)
class AskInventory:
    """Ask nodes which images they hold; answers come back as InventoryAnswered."""

    cameras: tuple[str, ...]


@dataclass(frozen=True)
class FetchImage:
    """Pull an image that a node holds."""

    manifest: Manifest


@dataclass(frozen=True)
class NoteOutcome:
    """Record a camera's new outcome and report it."""

    camera: str
    outcome: CameraOutcome


@dataclass(frozen=True)
class RefuseRound:
    """End the round without a capture. reasons : by camera, why it is not armed."""

    reasons: dict[str, str]


@dataclass(frozen=True)
class CloseCapture:
    """Close the capture's record with the outcome of every camera."""

    outcomes: dict[str, CameraOutcome]


Action = SendArm | OpenCapture | SendTrigger | AskInventory | FetchImage | NoteOutcome | RefuseRound | CloseCapture


@dataclass(frozen=True)
class CameraOutcome:
    """Outcome of a round for one camera: ``status`` pending, ok or failed, the last with the reason in words."""

    status: str = "pending"
    reason: str | None = None

    def __post_init__(self) -> None:
        if self.status not in ("pending", "ok", "failed"):
            raise ValueError(f"no such outcome: {self.status!r}")
        if self.status == "failed" and not self.reason:
            raise ValueError("a failed outcome must have a reason")
