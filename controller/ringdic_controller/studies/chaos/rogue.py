"""Somebody else on the rig's network: acknowledges images that are not archived, and sends what is no message."""

from __future__ import annotations

import json
from types import TracebackType

import zenoh
from ringdic_node.wire import Ack, Keys, Manifest, WireError, decode_as, encode

_BROKEN = (
    b'{"schema":1,"type":"status","a":' * 50_000,
    b'{"schema":1,"type":"status","node":"\\ud800","state":NaN}',
    b'{"schema":1,"type":"ack","node":1e999}',
    b"\xff\xfe\x00",
    b"",
)


class RoguePeer:
    """A session without a certificate, as a context manager.

    rig, endpoint : name of the rig, and where its controller listens. cameras : ids of its nodes. Raises
    ConnectionError where nobody listens.
    """

    def __init__(self, rig: str, endpoint: str, cameras: list[str]) -> None:
        self._keys = Keys(rig)
        self._endpoint = endpoint
        self._cameras = cameras
        self.forged = 0
        self._session: zenoh.Session | None = None

    def __enter__(self) -> RoguePeer:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([self._endpoint]))
        config.insert_json5("scouting/multicast/enabled", "false")
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise ConnectionError(f"nobody answers at {self._endpoint}") from error
        session = self._session
        self._subscriber = session.declare_subscriber(self._keys.image("*"), self._forge)
        for camera in self._cameras:
            for verb in ("ack", "status"):
                for payload in _BROKEN:
                    session.put(self._keys.node(camera, verb), payload)
            session.put(self._keys.image(camera), b"no image", attachment=_BROKEN[0])
            for verb in ("arm", "trigger", "fetch"):
                session.get(self._keys.node(camera, verb), lambda _: None, payload=_BROKEN[0], timeout=1.0)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the network."""
        if self._session is not None and not self._session.is_closed():
            self._session.close()

    def _forge(self, sample: zenoh.Sample) -> None:
        """Acknowledge an image in the controller's name, as quickly as can be."""
        try:
            manifest = decode_as(Manifest, sample.attachment.to_bytes() if sample.attachment else b"")
        except WireError:
            return
        assert self._session is not None
        self._session.put(
            self._keys.node(manifest.node, "ack"), encode(Ack(manifest.node, manifest.key, manifest.sha256))
        )
        self.forged += 1
