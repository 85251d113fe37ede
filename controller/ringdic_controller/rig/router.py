"""Zenoh's configuration of the controller's router: where it listens, and what each node may say and hear.

With certificates, access control knows a node by its certificate's name. Everything that is not listed is denied, also
to a certificate of the same authority that names another rig or a camera that the rig does not have. The controller
speaks from inside the router's process and is not filtered: it alone arms, triggers, fetches and acknowledges, since no
node may ask a question or put an acknowledgement.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import zenoh
from ringdic_node.endpoint import endpoint_security, node_name
from ringdic_node.wire import NETWORK, Keys


def router_config(endpoint: str, rig: str, cameras: Sequence[str], certificates: Path | None) -> zenoh.Config:
    """Configuration of the router that all nodes connect to.

    Parameters
    ----------
    endpoint
        Where it listens, like ``tls/0.0.0.0:7447``.
    rig, cameras
        Name of the rig and ids of its cameras.
    certificates
        Folder of the controller's certificate; None if there is none.

    Raises EndpointError for a plain endpoint that is not on loopback, and for certificates that cannot be used.
    """
    settings = {"mode": "router", "listen/endpoints": [endpoint], **NETWORK}
    security = endpoint_security(endpoint, certificates)
    if security:
        settings |= {**security, "access_control": access_control(rig, cameras)}
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def access_control(rig: str, cameras: Sequence[str]) -> dict[str, Any]:
    """The table ``access_control`` of Zenoh's configuration for the nodes of a rig's cameras."""
    keys = Keys(rig)
    shared = [
        _rule("controller/listens", "egress", ["declare_subscriber"], [keys.image("*"), keys.node("*", "status")]),
        _rule(
            "controller/watches", "egress", ["declare_liveliness_subscriber", "liveliness_query"], [keys.alive("**")]
        ),
    ]
    own = {node: list(_rules_of(keys, node)) for node in cameras}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [*shared, *(rule for rules in own.values() for rule in rules)],
        "subjects": [{"id": node, "cert_common_names": [node_name(rig, node)]} for node in cameras],
        "policies": [
            {"rules": [rule["id"] for rule in [*shared, *rules]], "subjects": [node]} for node, rules in own.items()
        ],
    }


def _rules_of(keys: Keys, node: str) -> Iterable[dict[str, Any]]:
    """What one node may do: all of it under keys with its own id."""
    yield _rule(f"{node}/tells", "ingress", ["put"], [keys.image(node), keys.node(node, "status")])
    yield _rule(f"{node}/answers", "ingress", ["declare_queryable", "reply"], [keys.node(node, "*")])
    yield _rule(f"{node}/lives", "ingress", ["liveliness_token"], [f"{keys.alive(node)}/**"])  # itself included
    yield _rule(f"{node}/subscribes", "ingress", ["declare_subscriber"], [keys.node(node, "ack")])
    yield _rule(f"{node}/is acknowledged", "egress", ["put"], [keys.node(node, "ack")])
    yield _rule(f"{node}/is asked", "egress", ["query"], [keys.node(node, "*")])


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
