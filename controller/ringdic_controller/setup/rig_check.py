"""What is wrong with the files of a rig, in words: configuration, certificates, cards, users."""

from __future__ import annotations

import os
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from ringdic.errors import InputError
from ringdic.session.names import checked_name
from ringdic.session.rig import Rig, read_rig
from ringdic_node.endpoint import CERTIFICATE, EndpointError, endpoint_host, endpoint_security, is_loopback

from ringdic_controller.access.certificates import RigMachine, hosts_of, machine_fault, machines_of
from ringdic_controller.service.config import ControllerConfig, read_controller_config
from ringdic_controller.service.page_security import page_security

ROOM = 20 << 30  # bytes: about two hundred captures of twelve cameras


@dataclass(frozen=True)
class Check:
    """One thing that was looked at. fault : what is wrong with it and what to do; empty where nothing is."""

    what: str
    fault: str = ""


def check_rig(config_file: Path, now: datetime) -> list[Check]:
    """Look at everything that a controller.toml names, and at the cards beside it.

    Raises InputError if the file itself cannot be read.
    """
    config = read_controller_config(config_file)
    checks = [Check("controller.toml"), _rig(config), _endpoint(config), _page(config), _archive(config)]
    if config.rig is None or checks[1].fault:
        return checks
    rig = read_rig(config.rig)
    if endpoint_host(config.endpoint) and not is_loopback(endpoint_host(config.endpoint)):
        checks += _certificates(config, rig, now)
    cards = config_file.resolve().parent / "cards"
    if cards.is_dir():
        checks += [_card(cards / camera.id / "user-data", rig, camera.id, config) for camera in rig.cameras]
    return checks


def _rig(config: ControllerConfig) -> Check:
    what = "rig.toml"
    if config.rig is None:
        return Check(what, 'the configuration names no rig, so that nothing can be captured; add rig = "rig.toml"')
    try:
        rig = read_rig(config.rig)
        checked_name("the rig's name", rig.name)
    except InputError as error:
        return Check(what, str(error))
    azimuths = [round(camera.azimuth_deg % 360, 3) for camera in rig.cameras]
    twice = sorted({azimuth for azimuth in azimuths if azimuths.count(azimuth) > 1})
    if twice:
        return Check(what, f"two cameras stand at azimuth {twice[0]:g}°; measure them, good to ± 5°")
    return Check(f"{what}: {rig.name}, {len(rig.cameras)} cameras")


def _endpoint(config: ControllerConfig) -> Check:
    try:
        endpoint_security(config.endpoint, config.certificates)
    except EndpointError as error:
        return Check("nodes' endpoint", str(error))
    note = " (this machine alone: no Pi can reach it)" if is_loopback(endpoint_host(config.endpoint)) else ""
    return Check(f"nodes' endpoint: {config.endpoint}{note}")


def _page(config: ControllerConfig) -> Check:
    try:
        secured = page_security(config)
    except InputError as error:
        return Check("page", str(error))
    login = "with login" if secured.access.logins else "without login"
    return Check(f"page: {secured.scheme}://{config.host}:{config.port}, {login}")


def _archive(config: ControllerConfig) -> Check:
    folder = next(path for path in (config.archive, *config.archive.resolve().parents) if path.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        return Check("archive", f"{folder} cannot be written by this user; change its owner, or [archive] to another")
    free = shutil.disk_usage(folder).free
    if free < ROOM:
        return Check("archive", f"{folder} has {free / 1e9:.1f} GB free, which a session fills; make room")
    return Check(f"archive: {config.archive}, {free / 1e9:.0f} GB free")


def _certificates(config: ControllerConfig, rig: Rig, now: datetime) -> Iterator[Check]:
    """The certificates of all machines that lie beside the controller's own."""
    if config.certificates is None:
        return
    folder = config.certificates.parent
    try:
        machines = machines_of(rig.name, [camera.id for camera in rig.cameras], [], folder)
    except InputError as error:
        yield Check("certificates", str(error))
        return
    own = RigMachine("controller", machines[0].common_name, config.certificates, machines[0].hosts)
    for machine in (own, *machines[1:]):
        if machine is not own and not (folder / "nodes").is_dir():
            continue  # the nodes' certificates were made elsewhere
        try:
            fault = machine_fault(machine, now)
        except InputError as error:
            fault = str(error)
        what = f"certificate of {machine.label}"
        advice = "make it with 'ringdic rig certificates', and take it to its machine"
        yield Check(what, f"the certificate in {machine.folder} {fault}; {advice}" if fault else "")


def _card(path: Path, rig: Rig, camera: str, config: ControllerConfig) -> Check:
    """The ``user-data`` of one node: whose it is, where it connects, and whether its certificate is the present one."""
    what = f"card of {camera}"
    try:
        text = path.read_text(encoding="utf-8")
        node = tomllib.loads(_block(text, "/etc/ringdic/node.toml"))
    except FileNotFoundError:
        return Check(what, f"{path} is missing; write it with 'ringdic rig init'")
    except (OSError, ValueError) as error:
        return Check(what, f"{path} cannot be used ({error}); write it anew with 'ringdic rig init'")
    faults = [
        f"{key} is '{node.get(key)}' and not '{wanted}'"
        for key, wanted in (("rig", rig.name), ("id", camera))
        if node.get(key) != wanted
    ]
    endpoint = str(node.get("controller", ""))
    if endpoint.rpartition(":")[2] != config.endpoint.rpartition(":")[2]:
        faults.append(f"it connects to {endpoint}, and the controller listens at {config.endpoint}")
    protocol, wanted = (each.partition("/")[0] for each in (endpoint, config.endpoint))
    if protocol != wanted:
        faults.append(f"it connects by {protocol}, and the controller listens by {wanted}")
    if config.certificates is not None and not faults:
        faults += _card_certificates(text, endpoint, camera, config.certificates)
    advice = "write it anew with 'ringdic rig init', and take it to the card"
    return Check(what, f"{path}: {'; '.join(faults)}; {advice}" if faults else "")


def _card_certificates(text: str, endpoint: str, camera: str, own: Path) -> Iterator[str]:
    present = own.parent / "nodes" / camera / CERTIFICATE
    if present.is_file():
        written = _block(text, f"/etc/ringdic/certificates/{CERTIFICATE}")
        if written.split() != present.read_text(encoding="ascii").split():
            yield "its certificate is not the one of today"
    certificate = RigMachine("controller", "", own).certificate()
    if certificate is not None and endpoint_host(endpoint).lower() not in hosts_of(certificate):
        yield f"it connects to {endpoint_host(endpoint)}, which the controller's certificate does not name"


def _block(text: str, path: str) -> str:
    """Content of a file that a ``user-data`` writes. Raises ValueError where it writes none of this path."""
    _, found, rest = text.partition(f"- path: {path}\n")
    _, _, rest = rest.partition("content: |\n")
    if not found:
        raise ValueError(f"it does not write {path}")
    lines = []
    for line in rest.splitlines():
        if line.strip() and not line.startswith("      "):
            break
        lines.append(line[6:])
    return "\n".join(lines)
