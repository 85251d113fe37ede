"""The node's configuration file (TOML) and the camera that it names.

::

    rig = "ring-12"
    id = "cam_01"
    controller = "tls/192.168.1.10:7447"
    certificates = "/etc/ringdic/certificates"
    spool = "/var/lib/ringdic/spool"
    camera = "pi"                       # or "virtual", "pattern", "playback"

    [pi]                                # settings of the camera chosen, all optional
    size = [3280, 2464]
    sync = "client"

Relative paths of the spool, of the certificates and of a playback image are taken from the folder of the configuration
file. A controller on the same machine may have an endpoint ``tcp/…`` without certificates.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from ringdic_node.cameras.camera import NodeCamera
from ringdic_node.clock import Clock
from ringdic_node.wire import WireError, valid_name


class ConfigError(ValueError):
    """The configuration cannot be used; the text names the file, the key and what to do."""


_CAMERA_KEYS: dict[str, dict[str, type | tuple[type, ...]]] = {
    "pi": {
        "size": list,
        "raw": bool,
        "sync": str,
        "tuning": str,
        "period_us": (int, float),
        "settle_frames": int,
        "buffers": int,
        "row_time_us": (int, float),
    },
    "virtual": {
        "cameras": int,
        "scale": (int, float),
        "seed": int,
        "specimen": str,
        "jitter_us": (int, float),
        "offset_us": (int, float),
    },
    "pattern": {
        "width": int,
        "height": int,
        "delay": (int, float),
        "jitter_us": (int, float),
        "seed": int,
    },
    "playback": {"image": str},
}


@dataclass(frozen=True)
class NodeConfig:
    """Configuration of a node.

    rig, id : names of the rig and of this camera. controller : Zenoh endpoint. camera : kind of camera, with
    ``camera_settings``. spool_reserve_mb : MiB of the disk that images leave free. spool_keep_mb : MiB of delivered
    images that are kept while there is room. arm_captures : number of captures that must find room before the camera
    arms. resend_s, status_s : seconds until an unacknowledged image is sent again, and between two status messages.
    certificates : folder of this node's certificate, for an endpoint ``tls/…``.
    """

    rig: str
    id: str
    controller: str
    spool: Path
    camera: str
    camera_settings: Mapping[str, Any] = field(default_factory=dict)
    spool_reserve_mb: int = 64
    spool_keep_mb: int = 1024
    arm_captures: int = 10
    resend_s: float = 5.0
    status_s: float = 1.0
    certificates: Path = Path("/etc/ringdic/certificates")

    def __post_init__(self) -> None:
        try:
            valid_name("rig", self.rig)
            valid_name("id", self.id)
        except WireError as error:
            raise ConfigError(str(error)) from error
        if self.camera not in _CAMERA_KEYS:
            raise ConfigError(f"camera '{self.camera}' is none of {', '.join(_CAMERA_KEYS)}")
        if not re.fullmatch(r"(tcp|tls|quic)/\S+:\d+(#\S*)?", self.controller):
            raise ConfigError(f"controller '{self.controller}' is no endpoint; write it like tls/192.168.1.10:7447")
        if self.resend_s <= 0 or self.status_s <= 0 or self.arm_captures < 1:
            raise ConfigError("resend_s, status_s and arm_captures must be positive")
        if self.spool_reserve_mb < 0 or self.spool_keep_mb < 0:
            raise ConfigError("spool_reserve_mb and spool_keep_mb must not be negative")
        known = _CAMERA_KEYS[self.camera]
        for name, value in self.camera_settings.items():
            if name not in known:
                raise ConfigError(f"[{self.camera}] unknown key '{name}'; known are {', '.join(known)}")
            if not isinstance(value, known[name]) or (isinstance(value, bool) and known[name] is not bool):
                raise ConfigError(f"[{self.camera}] {name} cannot be {value!r}")


def read_node_config(path: Path) -> NodeConfig:
    """Read and check the configuration in the TOML file `path`; raises ConfigError."""
    path = Path(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file; write the node's configuration there") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: {error}") from error
    try:
        return _parse(table, path.parent)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _parse(table: dict[str, Any], folder: Path) -> NodeConfig:
    plain = {f.name for f in fields(NodeConfig)} - {"camera_settings"}
    sections = set(_CAMERA_KEYS)
    for key in table:
        if key not in plain | sections:
            raise ConfigError(f"unknown key '{key}'; known are {', '.join(sorted(plain | sections))}")
    for key in ("rig", "id", "controller", "spool", "camera"):
        if not isinstance(table.get(key), str):
            raise ConfigError(f"the key '{key}' is missing or not a text in quotes")
    if not isinstance(table.get("certificates", ""), str):
        raise ConfigError("certificates must be a folder in quotes")
    numbers = {}
    for key in ("spool_reserve_mb", "spool_keep_mb", "arm_captures", "resend_s", "status_s"):
        if key in table:
            if not isinstance(table[key], int | float) or isinstance(table[key], bool):
                raise ConfigError(f"{key} must be a number, not {table[key]!r}")
            numbers[key] = table[key]
    settings = table.get(table["camera"], {})
    if not isinstance(settings, dict):
        raise ConfigError(f"[{table['camera']}] must be a table")
    if table["camera"] == "playback" and isinstance(settings.get("image"), str):
        settings = {**settings, "image": str(folder / settings["image"])}
    return NodeConfig(
        rig=table["rig"],
        id=table["id"],
        controller=table["controller"],
        spool=folder / table["spool"],
        camera=table["camera"],
        camera_settings=settings,
        certificates=folder / table.get("certificates", NodeConfig.certificates),
        **numbers,
    )


def make_camera(config: NodeConfig, clock: Clock) -> NodeCamera:
    """Build the camera that the configuration names; only its module is imported. Raises CameraError."""
    settings = dict(config.camera_settings)
    if config.camera == "pattern":
        from ringdic_node.cameras.pattern import PatternCamera

        return PatternCamera(config.id, clock, **settings)
    if config.camera == "playback":
        from ringdic_node.cameras.playback import PlaybackCamera

        return PlaybackCamera(clock, **settings)
    if config.camera == "virtual":
        from ringdic_node.cameras.virtual import VirtualNodeCamera

        return VirtualNodeCamera(config.id, clock, **settings)
    from ringdic_node.cameras.pi import PiCamera

    return PiCamera(clock, **settings)
