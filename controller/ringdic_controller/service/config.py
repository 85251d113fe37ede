"""The controller's configuration file: TOML, every key optional, unknown keys refused by name.

::

    archive = "archive"              # folder of the sessions; relative to this file
    rig = "rig.toml"                 # the rig whose nodes are expected; without it the controller only shows
    settings = "settings.toml"       # settings of the processing
    live = true                      # each step of the specimen is processed at once, and shown

    [http]
    host = "127.0.0.1"               # the page has no password: another address opens it to that network
    port = 8000                      # 0: a free port

    [zenoh]
    endpoint = "tcp/127.0.0.1:7447"  # where the nodes connect
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ringdic.errors import InputError

_KEYS = {"": {"archive", "rig", "settings", "live", "http", "zenoh"}, "http": {"host", "port"}, "zenoh": {"endpoint"}}


@dataclass(frozen=True)
class ControllerConfig:
    """Where the controller keeps, listens and serves."""

    archive: Path = Path("ringdic-archive")
    rig: Path | None = None
    settings: Path | None = None
    live: bool = True
    host: str = "127.0.0.1"
    port: int = 8000
    endpoint: str = "tcp/127.0.0.1:7447"

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise InputError(f"[http] port {self.port} is not a port; use 0 … 65535")
        if not self.host:
            raise InputError("[http] host is empty; use 127.0.0.1 for this PC alone")
        if "/" not in self.endpoint or ":" not in self.endpoint:
            raise InputError(f"[zenoh] endpoint '{self.endpoint}' is not of the form tcp/ADDRESS:PORT")


def read_controller_config(path: Path | None) -> ControllerConfig:
    """The configuration of a TOML file, the defaults without one; relative paths are taken from the file's folder.

    Raises InputError, naming the file and the key at fault.
    """
    if path is None:
        return ControllerConfig()
    path = Path(path)
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        return _config(tables, path.resolve().parent)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such configuration file") from error
    except (InputError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {error}") from error


def _config(tables: dict[str, Any], folder: Path) -> ControllerConfig:
    _refuse_unknown("", tables)
    config = ControllerConfig(archive=folder / "ringdic-archive")
    for name in ("archive", "rig", "settings"):
        if name in tables:
            config = replace(config, **{name: folder / _typed(tables[name], str, name)})
    if "live" in tables:
        config = replace(config, live=_typed(tables["live"], bool, "live"))
    for table, types in (("http", {"host": str, "port": int}), ("zenoh", {"endpoint": str})):
        values = _typed(tables.get(table, {}), dict, f"[{table}]")
        _refuse_unknown(table, values)
        for name, kind in types.items():
            if name in values:
                config = replace(config, **{name: _typed(values[name], kind, f"[{table}] {name}")})
    return config


def _refuse_unknown(table: str, values: dict[str, Any]) -> None:
    for key in values:
        if key not in _KEYS[table]:
            where = f"[{table}] " if table else ""
            raise InputError(f"{where}unknown key '{key}'; known are {', '.join(sorted(_KEYS[table]))}")


def _typed(value: Any, kind: type, where: str) -> Any:
    if not isinstance(value, kind) or isinstance(value, bool) is not (kind is bool):
        wanted = {bool: "true or false", str: "text in quotes", int: "a whole number", dict: "a table"}[kind]
        raise InputError(f"{where} must be {wanted}, not {value!r}")
    return value
