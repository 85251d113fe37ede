"""The files of all machines of a rig, written from a few answers, so that no card needs an edit by hand.

A folder of a rig::

    rig.toml                  the rig; one that is there already is taken as it is
    controller.toml           the controller's configuration, beside the rig and its certificates
    certificates/             what `ringdic_controller.access.certificates` makes
    cards/<id>/user-data      first boot of the node: its configuration, its certificates, and who may log in
    inventory.yml             the nodes, for the playbooks that install a release on them
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template

from ringdic.errors import InputError
from ringdic.session.names import checked_name
from ringdic.session.rig import Rig, parse_rig
from ringdic_node.endpoint import AUTHORITY, CERTIFICATE, KEY

PORT = 7447
CAMERA_KINDS = ("pi", "pattern")
_SSH_KEY = re.compile(r"(ssh|ecdsa|sk)-[\w.@-]+ [A-Za-z0-9+/]{40,}={0,3}( [^\"\\\n]*)?")


@dataclass(frozen=True)
class RigAnswers:
    """What is asked for a rig. host : the controller's address on the rig's network. ssh_key : one line, public.

    camera : kind of camera of all nodes, as in node.toml.
    """

    host: str
    ssh_key: str
    camera: str = "pi"

    def __post_init__(self) -> None:
        if self.camera not in CAMERA_KINDS:
            raise InputError(f"--camera {self.camera!r} is none of {', '.join(CAMERA_KINDS)}")
        if not _SSH_KEY.fullmatch(self.ssh_key):
            raise InputError("the public key of ssh must be one line such as 'ssh-ed25519 AAAA… name'; see ssh-keygen")


def rig_text(name: str, cameras: Sequence[str], first_azimuth_deg: float = 0.0) -> str:
    """Text of a rig.toml for cameras that stand evenly once around, from an azimuth in degrees counter-clockwise."""
    checked_name("the rig's name", name)
    for camera in cameras:
        checked_name("the camera's id", camera)
    tables = [
        f'\n[[cameras]]\nid = "{camera}"\nazimuth_deg = {(first_azimuth_deg + 360 * k / len(cameras)) % 360:.1f}\n'
        for k, camera in enumerate(cameras)
    ]
    text = _filled("rig.toml", name=name, cameras="".join(tables))
    parse_rig(text)  # its errors name what is wrong
    return text


def controller_text(answers: RigAnswers) -> str:
    """Text of the controller's configuration."""
    return _filled("controller.toml", host=answers.host, port=PORT)


def card_text(rig: Rig, camera: str, answers: RigAnswers, certificates: Path) -> str:
    """Text of a card's ``user-data``. certificates : the node's folder of its three files."""
    host = f"[{answers.host}]" if ":" in answers.host else answers.host
    node = _filled("node.toml", rig=rig.name, id=camera, host=host, port=PORT, camera=answers.camera)
    contents = {
        name: _indented((certificates / file).read_text(encoding="ascii"))
        for name, file in (("authority", AUTHORITY), ("certificate", CERTIFICATE), ("key", KEY))
    }
    contents["node_toml"] = _indented(node)
    return _filled("user-data", id=camera, hostname=host_name(camera), ssh_key=answers.ssh_key, **contents)


def inventory_text(rig: Rig) -> str:
    """Text of the inventory of the playbooks."""
    hosts = "\n".join(f"    {host_name(camera.id)}:" for camera in rig.cameras)
    return _filled("inventory.yml", hosts=hosts)


def host_name(camera: str) -> str:
    """Name of a node on the network: letters, digits and dashes of the camera's id, behind ``ring-cam-``."""
    return "ring-cam-" + re.sub(r"[^a-z0-9]+", "-", camera.lower()).strip("-")


def check_names(rig: Rig) -> None:
    """Raise InputError for a rig whose name no message can have, and for cameras whose nodes would have one name."""
    checked_name("the rig's name", rig.name)
    owners: dict[str, str] = {}
    for camera in rig.cameras:
        name = host_name(camera.id)
        if name in owners or len(name) > 63:
            raise InputError(
                f"the node of camera '{camera.id}' would be called {name}, "
                + (f"like that of '{owners[name]}'" if name in owners else "which is too long")
                + "; choose another id"
            )
        owners[name] = camera.id


def write_text(path: Path, text: str) -> None:
    """Replace a file in one step; only its owner may read it, since it may hold a key."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.new")
    partial.unlink(missing_ok=True)
    private = path.name == "user-data"
    descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600 if private else 0o644)
    with os.fdopen(descriptor, "w", encoding="utf-8", newline="\n") as file:
        file.write(text)
    os.replace(partial, path)


def _filled(template: str, **values: object) -> str:
    text = (files("ringdic_controller.setup") / "templates" / template).read_text(encoding="utf-8")
    return Template(text).substitute(values)


def _indented(text: str) -> str:
    return "\n".join(f"      {line}" for line in text.strip().splitlines())
