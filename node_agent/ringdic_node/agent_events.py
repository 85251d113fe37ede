"""What the node's state machine is given and what it asks for: events and actions, both frozen.

Standard library only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ringdic_node.wire import (
    Ack,
    Arm,
    ArmReply,
    CaptureKey,
    Failure,
    Inventory,
    Manifest,
    Trigger,
    TriggerReply,
)

# Events ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ArmAsked:
    """The controller asks this node to lock its camera.

    question : number of the query, which the answer names. obstacle : why this node cannot take part at present, though
    its camera may be locked; empty if it can.
    """

    message: Arm
    question: int
    obstacle: str = ""


@dataclass(frozen=True)
class CameraLocked:
    """The camera is locked to the settings that were asked for; `reply` is the answer to all who asked."""

    reply: ArmReply


@dataclass(frozen=True)
class CameraRefused:
    """The camera could not be locked to the settings with this hash; `reason` says why."""

    settings_hash: str
    reason: str


@dataclass(frozen=True)
class Triggered:
    """A trigger has arrived. question : number of the query, which the answer names."""

    message: Trigger
    question: int


@dataclass(frozen=True)
class FrameSpooled:
    """The frame of the capture under way is in the spool, safe against a power cut."""

    manifest: Manifest


@dataclass(frozen=True)
class FrameLost:
    """The camera or the spool failed: there will be no image of this capture."""

    key: CaptureKey
    reason: str


@dataclass(frozen=True)
class Sent:
    """An image has been handed to the network, or that failed; neither tells whether it arrived."""

    key: CaptureKey


@dataclass(frozen=True)
class Acknowledged:
    """The controller has acknowledged an image, or says that it does not know the capture."""

    message: Ack


@dataclass(frozen=True)
class DeliveredRemoved:
    """The spool has removed images that were delivered, to make room."""

    keys: tuple[CaptureKey, ...]


@dataclass(frozen=True)
class InventoryAsked:
    """The controller asks what this node holds. question : number of the query, which the answer names."""

    question: int


@dataclass(frozen=True)
class FetchAsked:
    """The controller asks for the image of one capture. question : number of the query, which the answer names."""

    key: CaptureKey
    question: int


@dataclass(frozen=True)
class AgentTick:
    """Time has passed."""


Event = (
    ArmAsked
    | CameraLocked
    | CameraRefused
    | Triggered
    | FrameSpooled
    | FrameLost
    | Sent
    | Acknowledged
    | DeliveredRemoved
    | InventoryAsked
    | FetchAsked
    | AgentTick
)


# Actions -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LockCamera:
    """Lock the camera to these settings; the event CameraLocked or CameraRefused follows."""

    settings: dict[str, Any]
    settings_hash: str


@dataclass(frozen=True)
class TakeFrame:
    """Capture the frame nearest to the trigger's moment and spool it; FrameSpooled or FrameLost follows."""

    trigger: Trigger


@dataclass(frozen=True)
class Publish:
    """Send the image of this manifest from the spool; the event Sent follows."""

    manifest: Manifest


@dataclass(frozen=True)
class Free:
    """Note in the spool that an image was delivered: it may be removed when its room is needed."""

    key: CaptureKey
    sha256: str


@dataclass(frozen=True)
class Report:
    """Tell the controller that there is no image of a capture, and why."""

    failure: Failure


@dataclass(frozen=True)
class Answer:
    """Answer a question with a message."""

    question: int
    message: ArmReply | TriggerReply | Inventory


@dataclass(frozen=True)
class AnswerImage:
    """Answer a question with the image of this manifest from the spool."""

    question: int
    manifest: Manifest


@dataclass(frozen=True)
class Decline:
    """Answer a question with an error and its reason."""

    question: int
    reason: str


Action = LockCamera | TakeFrame | Publish | Free | Report | Answer | AnswerImage | Decline
