"""The contract between node and controller: key expressions, messages, encoding.

It is the only module of the node that the controller imports for its link. Standard library only.

Keys
----
``rig/<rig>/node/<id>/arm``        query: Arm -> ArmReply
``rig/<rig>/node/<id>/trigger``    query: Trigger -> TriggerReply
``rig/<rig>/node/<id>/inventory``  query: (empty) -> Inventory
``rig/<rig>/node/<id>/fetch``      query: Fetch -> image bytes, Manifest as attachment
``rig/<rig>/node/<id>/clock``      query: (empty) -> ClockReading, at once
``rig/<rig>/node/<id>/preview``    query: (empty) -> a small PGM of the newest frame
``rig/<rig>/node/<id>/ack``        put by the controller: Ack
``rig/<rig>/node/<id>/status``     put by the node: Status or Failure; as a query: (empty) -> Status
``rig/<rig>/img/<id>``             put by the node: image bytes, Manifest as attachment
``rig/<rig>/alive/<id>``           liveliness token of the node
``rig/<rig>/alive/<id>/<process>`` liveliness token of the process that speaks as this node

Messages are JSON objects with ``schema`` and ``type``; image bytes travel raw. A message is checked when it is built,
so an invalid one cannot exist on either side. Fields that one side does not know are ignored by it. All times are
integers, ns since the Unix epoch on the controller's clock, except where a field says that it is of the node's clocks.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, get_args

from ringdic_node.checks import (
    require_hash,
    require_hash_if_given,
    require_in,
    require_int,
    require_optional,
    require_table,
    require_texts,
    valid_name,
)
from ringdic_node.json_document import WireError, build, document_of, plain, read_document, shown

SCHEMA = 1

# The kinds of capture and the rule of names are those of `ringdic.session.names`, repeated here because a node has
# no package `ringdic`. A test compares the two.
CAPTURE_KINDS = ("board", "target", "specimen", "static")
NODE_STATES = ("idle", "arming", "armed", "capturing")
TRIGGER_VERDICTS = ("accepted", "missed", "refused", "not armed")
ACK_VERDICTS = ("archived", "unknown")

MAX_MESSAGE = 64 << 20
IMAGE_LIMIT = MAX_MESSAGE - (1 << 20)  # bytes; a larger message is dropped by its receiver without a word

# Zenoh's configuration that both sides share. Shared memory drops messages silently and
# is slower for images; waiting on a frozen receiver must end before the lease does, or images vanish unnoticed.
NETWORK: dict[str, object] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/shared_memory/enabled": False,
    "transport/link/rx/max_message_size": MAX_MESSAGE,
    "transport/link/tx/lease": 10_000,
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 8_000_000,
}


@dataclass(frozen=True)
class Keys:
    """The key expressions of one rig. `node` may be ``*`` for all nodes."""

    rig: str

    def __post_init__(self) -> None:
        valid_name("rig", self.rig)

    def node(self, node: str, verb: str) -> str:
        """Key of one verb of a node: arm, trigger, inventory, fetch, clock, preview, ack or status."""
        return f"rig/{self.rig}/node/{node}/{verb}"

    def image(self, node: str) -> str:
        """Key under which a node publishes its images."""
        return f"rig/{self.rig}/img/{node}"

    def alive(self, node: str) -> str:
        """Key of the liveliness token of a node."""
        return f"rig/{self.rig}/alive/{node}"

    def instance(self, node: str, instance: str) -> str:
        """Key of the liveliness token of one process that speaks as a node."""
        return f"rig/{self.rig}/alive/{node}/{instance}"


@dataclass(frozen=True, order=True)
class CaptureKey:
    """Identity of a capture: session, id and planned moment, ns; the moment distinguishes sessions of the same name."""

    session: str
    capture_id: str
    fire_at_ns: int

    def __post_init__(self) -> None:
        valid_name("session", self.session)
        valid_name("capture_id", self.capture_id)
        require_int("fire_at_ns", self.fire_at_ns, at_least=0)

    def __str__(self) -> str:
        return f"{self.session}/{self.capture_id}"

    @property
    def stem(self) -> str:
        """File name of the capture without its suffix; the parts are joined by ``~``, which no name contains."""
        return f"{self.session}~{self.capture_id}~{self.fire_at_ns}"


def hash_of_settings(settings: dict[str, Any]) -> str:
    """SHA-256 of camera settings in canonical JSON (sorted, without spaces), in hexadecimal."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


class _Message:
    """Base of all messages: frozen dataclasses whose class variable `TYPE` names them in the JSON."""

    TYPE: ClassVar[str]


@dataclass(frozen=True)
class Arm(_Message):
    """Request to lock the camera for a session. `settings_hash` is `hash_of_settings` of `settings`."""

    TYPE: ClassVar[str] = "arm"
    session: str
    kind: str
    settings: dict[str, Any]
    settings_hash: str
    expected: tuple[str, ...]

    def __post_init__(self) -> None:
        valid_name("session", self.session)
        require_in("kind", self.kind, CAPTURE_KINDS)
        require_table("settings", self.settings)
        require_hash("settings_hash", self.settings_hash)
        for node in self.expected:
            valid_name("node", node)


@dataclass(frozen=True)
class ArmReply(_Message):
    """Answer to `Arm`: whether the camera is locked, and to what.

    `frame_time_ns` and `frame_period_ns` are the time of one frame and the period, ns, of a sensor that takes frames
    continuously. `instance`, `host` and `address` tell which process answers, and where it runs.
    """

    TYPE: ClassVar[str] = "arm-reply"
    node: str
    armed: bool
    settings_hash: str
    reason: str = ""
    locked: dict[str, Any] = field(default_factory=dict)
    sync: str = "none"
    clock_offset_ms: float | None = None
    clock_error_ms: float | None = None
    frame_time_ns: int | None = None
    frame_period_ns: int | None = None
    spool_free: int = 0
    versions: dict[str, str] = field(default_factory=dict)
    instance: str = ""
    host: str = ""
    address: str = ""

    def __post_init__(self) -> None:
        valid_name("node", self.node)
        require_hash("settings_hash", self.settings_hash)
        require_table("locked", self.locked)
        require_texts("versions", self.versions)
        require_optional(self, "frame_time_ns", "frame_period_ns")
        if not self.armed and not self.reason:
            raise WireError("an ArmReply that is not armed must give the reason")


@dataclass(frozen=True)
class Trigger(_Message):
    """Request to keep the frame nearest to `key.fire_at_ns`.

    `scene` counts the captures of this kind, for simulated rigs. `settings_hash` is that of the settings that the
    camera must be locked to; empty from a controller that does not say. `clock_zero_ns` is the controller's time at
    which the node's monotonic clock was zero, by which the node finds the moment; `clock_offset_ns` the offset of
    the node's wall clock when it was armed, `clock_error_ns` the bound of the error of both, as the controller
    measured them.
    """

    TYPE: ClassVar[str] = "trigger"
    key: CaptureKey
    kind: str
    scene: int = 0
    settings_hash: str = ""
    clock_zero_ns: int | None = None
    clock_offset_ns: int | None = None
    clock_error_ns: int | None = None

    def __post_init__(self) -> None:
        require_hash_if_given("settings_hash", self.settings_hash)
        require_in("kind", self.kind, CAPTURE_KINDS)
        require_int("scene", self.scene, at_least=0)
        require_optional(self, "clock_zero_ns", "clock_offset_ns")
        require_optional(self, "clock_error_ns", at_least=0)


@dataclass(frozen=True)
class TriggerReply(_Message):
    """Answer to `Trigger`: accepted, missed (the moment had passed when it came), refused or not armed.

    ``late``, the word of earlier releases for ``missed``, is read as such.
    """

    TYPE: ClassVar[str] = "trigger-reply"
    node: str
    key: CaptureKey
    verdict: str
    reason: str = ""

    def __post_init__(self) -> None:
        valid_name("node", self.node)
        if self.verdict == "late":
            object.__setattr__(self, "verdict", "missed")
        require_in("verdict", self.verdict, TRIGGER_VERDICTS)


@dataclass(frozen=True)
class Manifest(_Message):
    """Description of one image file: capture, checksum, size, time, metadata.

    `time_ns` is the measured time of the frame; on the controller's clock, unless `clock_offset_ns` is None: then
    on the node's own. `clock_offset_ns` is what was subtracted for that, the offset of the node's wall clock;
    `clock_error_ns` bounds its error, and `clock_step_ns` is by how much the node's clock was set since it was
    armed. `row_time_ns` is the time from one row of the image to the next of a rolling shutter, ns. `settings_hash`
    is that of the settings that the camera was locked to; empty from a node that does not say. `unknown` are fields
    that another release has added; they stay with the manifest wherever it goes.
    """

    TYPE: ClassVar[str] = "manifest"
    node: str
    key: CaptureKey
    kind: str
    sha256: str
    bytes: int
    width: int
    height: int
    time_ns: int
    exposure_us: float | None = None
    format: str = "pgm"
    metadata: dict[str, Any] = field(default_factory=dict)
    settings_hash: str = ""
    clock_offset_ns: int | None = None
    clock_error_ns: int | None = None
    clock_step_ns: int | None = None
    row_time_ns: float | None = None
    unknown: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_hash_if_given("settings_hash", self.settings_hash)
        valid_name("node", self.node)
        require_in("kind", self.kind, CAPTURE_KINDS)
        require_hash("sha256", self.sha256)
        require_int("bytes", self.bytes, at_least=1)
        if self.bytes > IMAGE_LIMIT:
            raise WireError(f"an image of {self.bytes} bytes is too large to be sent; the limit is {IMAGE_LIMIT}")
        require_int("width", self.width, at_least=1)
        require_int("height", self.height, at_least=1)
        require_int("time_ns", self.time_ns, at_least=0)
        require_optional(self, "clock_offset_ns", "clock_step_ns")
        require_optional(self, "clock_error_ns", at_least=0)
        require_in("format", self.format, ("pgm",))
        require_table("metadata", self.metadata)


@dataclass(frozen=True)
class Failure(_Message):
    """Report of a capture that the node was triggered for and has no image of, with the reason."""

    TYPE: ClassVar[str] = "failure"
    node: str
    key: CaptureKey
    reason: str

    def __post_init__(self) -> None:
        valid_name("node", self.node)
        if not self.reason:
            raise WireError("a Failure must give the reason")


@dataclass(frozen=True)
class Inventory(_Message):
    """List of what a node holds: images in its spool, failures it remembers, the capture under way.

    `delivered` are images that were acknowledged and are still held: the newest, and in turn some of the others.
    """

    TYPE: ClassVar[str] = "inventory"
    node: str
    manifests: tuple[Manifest, ...] = ()
    failures: tuple[Failure, ...] = ()
    capturing: CaptureKey | None = None
    delivered: tuple[Manifest, ...] = ()

    def __post_init__(self) -> None:
        valid_name("node", self.node)

    def own_part(self) -> Inventory:
        """The list without what it says of other nodes: a node speaks for itself alone."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        for name, value in values.items():
            if isinstance(value, tuple):
                values[name] = tuple(entry for entry in value if entry.node == self.node)
        return Inventory(**values)


@dataclass(frozen=True)
class Fetch(_Message):
    """Request to answer with the image of this capture."""

    TYPE: ClassVar[str] = "fetch"
    key: CaptureKey


@dataclass(frozen=True)
class Ack(_Message):
    """Acknowledgement of an image by the controller.

    ``archived``: the image with this hash is safe; the node stops sending it, and removes it when it needs the room.
    ``unknown``: the archive has no such capture, and the node stops sending.
    """

    TYPE: ClassVar[str] = "ack"
    node: str
    key: CaptureKey
    sha256: str
    verdict: str = "archived"

    def __post_init__(self) -> None:
        valid_name("node", self.node)
        require_hash("sha256", self.sha256)
        require_in("verdict", self.verdict, ACK_VERDICTS)


@dataclass(frozen=True)
class NodeStatus(_Message):
    """The node's state, sent at an interval and on change. `time_ns` is the node's clock when it was sent.

    `detail` says what the operator should know. `instance`, `host` and `address` tell which process speaks, and where
    it runs.
    """

    TYPE: ClassVar[str] = "status"
    node: str
    state: str
    armed: bool
    time_ns: int
    spool_free: int
    spool_images: int
    versions: dict[str, str] = field(default_factory=dict)
    clock_offset_ms: float | None = None
    detail: str = ""
    instance: str = ""
    host: str = ""
    address: str = ""

    def __post_init__(self) -> None:
        valid_name("node", self.node)
        require_in("state", self.state, NODE_STATES)
        require_int("time_ns", self.time_ns, at_least=0)
        require_int("spool_free", self.spool_free, at_least=0)
        require_int("spool_images", self.spool_images, at_least=0)
        require_texts("versions", self.versions)


@dataclass(frozen=True)
class ClockReading(_Message):
    """Answer to a question for the node's clocks, given at once, by which the controller measures their offset.

    `received_ns` and `sent_ns` are readings of the node's monotonic clock when the question came and when the answer
    left, `wall_ns` is its wall clock at the latter. `frame_time_ns` and `frame_period_ns` are the time of the newest
    frame on the node's wall clock, and the period, of a sensor that takes frames continuously.
    """

    TYPE: ClassVar[str] = "clock"
    node: str
    received_ns: int
    sent_ns: int
    wall_ns: int
    frame_time_ns: int | None = None
    frame_period_ns: int | None = None

    def __post_init__(self) -> None:
        valid_name("node", self.node)
        require_int("received_ns", self.received_ns, at_least=0)
        require_int("sent_ns", self.sent_ns, at_least=self.received_ns)
        require_int("wall_ns", self.wall_ns, at_least=0)
        require_optional(self, "frame_time_ns")
        require_optional(self, "frame_period_ns", at_least=1)


Message = (
    Arm | ArmReply | Trigger | TriggerReply | Manifest | Failure | Inventory | Fetch | Ack | NodeStatus | ClockReading
)
_TYPES: dict[str, type[Any]] = {cls.TYPE: cls for cls in get_args(Message)}
# Fields that hold nested records or sequences of them, which JSON alone does not tell from tables.
_NESTED: dict[tuple[str, str], type[Any]] = {
    ("trigger", "key"): CaptureKey,
    ("trigger-reply", "key"): CaptureKey,
    ("manifest", "key"): CaptureKey,
    ("failure", "key"): CaptureKey,
    ("fetch", "key"): CaptureKey,
    ("ack", "key"): CaptureKey,
    ("inventory", "capturing"): CaptureKey,
    ("inventory", "manifests"): Manifest,
    ("inventory", "delivered"): Manifest,
    ("inventory", "failures"): Failure,
}


_FIRST_MANIFEST = (
    "schema", "type", "node", "key", "kind", "sha256", "bytes", "width", "height", "time_ns", "exposure_us", "format",
    "metadata",
)  # fmt: skip
_LATER = "fields of later releases"


def encode(message: Message) -> bytes:
    """Return the message as JSON bytes with its schema version and type."""
    document = {"schema": SCHEMA, "type": message.TYPE, **plain(document_of(message))}
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


def decode(payload: bytes) -> Message:
    """Return the message in `payload`; fields that this release does not know are ignored, a manifest keeps them.

    Raises
    ------
    WireError
        Not JSON, no schema or an unknown type, a missing or wrong field. A message of another schema is understood
        as far as it has the fields that are wanted here.
    """
    document = _with_later_fields(read_document(payload))
    schema = document.pop("schema", None)
    if not isinstance(schema, int) or isinstance(schema, bool) or schema < 1:
        raise WireError(f"the message has schema {shown(schema)}, which is no version of a contract")
    kind = document.pop("type", None)
    try:
        if not isinstance(kind, str) or kind not in _TYPES:
            raise WireError(f"the message type {shown(kind)} is none of {', '.join(_TYPES)}")
        return build(_TYPES[kind], kind, document, _NESTED)  # type: ignore[no-any-return]
    except WireError as error:
        if schema == SCHEMA:
            raise
        raise WireError(
            f"{error}; the message has schema {schema}, this side speaks schema {SCHEMA}: update the older side"
        ) from error


def encode_for_first_release(manifest: Manifest) -> bytes:
    """Return the manifest as JSON bytes that the first release can read, too: later fields are in its metadata.

    That release knows no other fields, and removes an image whose manifest it cannot read. `decode` puts them back.
    """
    document = {"schema": SCHEMA, "type": manifest.TYPE, **plain(document_of(manifest))}
    later = {name: document.pop(name) for name in list(document) if name not in _FIRST_MANIFEST}
    document["metadata"] = {**document["metadata"], _LATER: later}
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


def _with_later_fields(document: dict[str, Any]) -> dict[str, Any]:
    metadata = document.get("metadata")
    later = metadata.pop(_LATER, None) if isinstance(metadata, dict) else None
    return {**document, **later} if isinstance(later, dict) else document


def decode_as(expected: type[Any], payload: bytes) -> Any:
    """Return the message in `payload`, which must be of type `expected`; raises WireError."""
    message = decode(payload)
    if not isinstance(message, expected):
        raise WireError(f"expected a message of type {expected.TYPE!r}, got {message.TYPE!r}")
    return message
