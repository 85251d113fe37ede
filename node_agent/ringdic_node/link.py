"""The node's only contact with Zenoh: keys, queries, publications, priorities.

The session is a peer without a listener that connects to the controller by itself, whenever it appears.
A query that arrives gets a number and is passed on; it is answered later by that number.
"""

from __future__ import annotations

import itertools
import json
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import zenoh

from ringdic_node.endpoint import endpoint_security
from ringdic_node.wire import NETWORK, Keys, Manifest, Message, encode

log = logging.getLogger(__name__)

VERBS = ("arm", "trigger", "inventory", "fetch", "clock", "preview", "status")
RETRY = "retry_period_init_ms=200;retry_period_max_ms=1000"
SMALL_BUFFER = "so_sndbuf=65536"  # so that a trigger need not queue behind megabytes of image


class NodeLink:
    """A Zenoh session with this node's keys, as a context manager.

    Parameters
    ----------
    on_query : callable (verb, payload, question)
        Called from Zenoh's threads; must only enqueue. `question` is the number of the query, for `answer`.
    on_ack : callable (payload)
        Called from Zenoh's threads with an acknowledgement; must only enqueue.
    instance : str
        Name of this process, which is seen alive beside the node; empty for none.
    certificates : Path
        Folder of this node's certificate, for an endpoint ``tls/…``.

    Entering raises EndpointError for an endpoint or certificates that may not or cannot be used.
    """

    def __init__(
        self,
        keys: Keys,
        node: str,
        controller: str,
        on_query: Callable[[str, bytes, int], None],
        on_ack: Callable[[bytes], None],
        instance: str = "",
        certificates: Path | None = None,
    ) -> None:
        self._keys = keys
        self._node = node
        self._controller = controller
        self._on_query = on_query
        self._on_ack = on_ack
        self._instance = instance
        self._certificates = certificates
        self._questions: dict[int, zenoh.Query] = {}
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()

    def __enter__(self) -> NodeLink:
        self._session = zenoh.open(node_config(self._controller, self._certificates))
        # Queryables first, the liveliness token last: a node that is seen alive answers.
        self._queryables = [
            self._session.declare_queryable(self._keys.node(self._node, verb), self._receiver(verb)) for verb in VERBS
        ]
        self._acks = self._session.declare_subscriber(
            self._keys.node(self._node, "ack"), lambda sample: self._on_ack(sample.payload.to_bytes())
        )
        keys = [self._keys.instance(self._node, self._instance)] if self._instance else []
        keys.append(self._keys.alive(self._node))
        self._tokens = [self._session.liveliness().declare_token(key) for key in keys]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            self._questions.clear()
        self._session.close()

    def _receiver(self, verb: str) -> Callable[[zenoh.Query], None]:
        def receive(query: zenoh.Query) -> None:
            payload = query.payload
            with self._lock:
                question = next(self._numbers)
                self._questions[question] = query
            self._on_query(verb, payload.to_bytes() if payload is not None else b"", question)

        return receive

    @property
    def connected(self) -> bool:
        """Whether the controller's router is connected at this moment."""
        return bool(self._session.info.routers_zid())

    def answer(self, question: int, payload: bytes, manifest: Manifest | None = None) -> None:
        """Answer a query with bytes; the manifest of an image goes with them as the attachment."""
        query = self._take(question)
        if query is None:
            return
        attachment = encode(manifest) if manifest is not None else None
        try:
            query.reply(query.key_expr, payload, attachment=attachment)
        except zenoh.ZError as error:
            log.warning("an answer on %s could not be sent: %s", query.key_expr, error)
        finally:
            query.drop()

    def decline(self, question: int, reason: str) -> None:
        """Answer a query with an error, since no answer would look like a dead node."""
        query = self._take(question)
        if query is None:
            return
        try:
            query.reply_err(reason.encode("utf-8", "replace"))
        except zenoh.ZError as error:
            log.warning("a refusal on %s could not be sent: %s", query.key_expr, error)
        finally:
            query.drop()

    def _take(self, question: int) -> zenoh.Query | None:
        with self._lock:
            return self._questions.pop(question, None)

    def publish_image(self, manifest: Manifest, image: bytes) -> None:
        """Send an image; blocks while the network is busy. Returning does not mean that it arrived."""
        try:
            self._session.put(
                self._keys.image(self._node),
                image,
                attachment=encode(manifest),
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
            )
        except zenoh.ZError as error:
            log.warning("the image of %s could not be sent: %s", manifest.key, error)

    def publish_status(self, message: Message) -> None:
        """Send a status or a failure; the network may drop it, and the next inventory repeats it."""
        try:
            self._session.put(
                self._keys.node(self._node, "status"),
                encode(message),
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.INTERACTIVE_LOW,
            )
        except zenoh.ZError as error:
            log.warning("the status could not be sent: %s", error)


def node_config(controller: str, certificates: Path | None = None) -> zenoh.Config:
    """Zenoh's configuration of a node: a peer that connects to the controller and retries without end.

    Raises EndpointError for a plain endpoint on another machine, and for certificates that cannot be used.
    """
    config = zenoh.Config()
    parameters = f"{RETRY};{SMALL_BUFFER}" if controller.startswith(("tcp/", "tls/")) else RETRY
    settings = {
        "mode": "peer",
        "listen/endpoints": [],
        "connect/endpoints": [f"{controller}{';' if '#' in controller else '#'}{parameters}"],
        **NETWORK,
        **endpoint_security(controller, certificates),
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config
