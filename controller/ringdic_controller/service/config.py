"""The controller's configuration file: TOML, every key optional, unknown keys refused by name.

::

    archive = "archive"              # folder of the sessions; relative to this file
    rig = "rig.toml"                 # the rig whose nodes are expected; without it the controller only shows
    settings = "settings.toml"       # settings of the processing
    live = true                      # each step is processed as soon as it is archived, and shown
    certificates = "certificates/controller"  # made by `ringdic rig certificates`
    users = "users.json"             # made by `ringdic users add`; with it the page asks who you are

    [http]
    host = "127.0.0.1"               # another address needs certificates and users
    port = 8000                      # 0: a free port
    hosts = ["lab-pc"]               # further names that the page is opened by; others are refused

    [zenoh]
    endpoint = "tcp/127.0.0.1:7447"  # where the nodes connect; another address needs certificates and tls/…
"""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Strict, StrictBool, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass
from ringdic.errors import InputError
from ringdic.settings import TABLE, faults


def _named_host(host: str) -> str:
    if not host:
        raise ValueError("is empty; use 127.0.0.1 for this PC alone")
    return host


def _tcp_port(port: int) -> int:
    if not 0 <= port <= 65535:
        raise ValueError(f"{port} is not a port; use 0 … 65535")
    return port


def _tcp_endpoint(endpoint: str) -> str:
    if "/" not in endpoint or ":" not in endpoint:
        raise ValueError(f"'{endpoint}' is not of the form tls/ADDRESS:PORT")
    return endpoint


def _lower_case(name: str) -> str:
    return name.lower()


Host = Annotated[str, AfterValidator(_named_host)]
Port = Annotated[int, Strict(), AfterValidator(_tcp_port)]
HostName = Annotated[Host, AfterValidator(_lower_case)]
Endpoint = Annotated[str, AfterValidator(_tcp_endpoint)]


@dataclass(frozen=True, config=TABLE)
class ControllerConfig:
    """Configuration of the controller.

    archive : folder of the sessions. rig : the rig file; None for a controller that only shows sessions. settings :
    settings file of the processing. live : whether each step is processed as soon as it is archived. host, port : of
    the page. endpoint : where the nodes connect. hosts : further names by which the page may be opened, in lower case.
    certificates : folder of the controller's certificate. users : file of
    those who may use the page; None where whoever reaches it may.
    """

    archive: Path = Path("ringdic-archive")
    rig: Path | None = None
    settings: Path | None = None
    live: StrictBool = True
    host: Host = "127.0.0.1"
    port: Port = 8000
    endpoint: Endpoint = "tcp/127.0.0.1:7447"
    hosts: tuple[HostName, ...] = ()
    certificates: Path | None = None
    users: Path | None = None


@dataclass(frozen=True, config=TABLE)
class _Http:
    """The table ``[http]``."""

    host: Host = ControllerConfig.host
    port: Port = ControllerConfig.port
    hosts: tuple[HostName, ...] = ControllerConfig.hosts


@dataclass(frozen=True, config=TABLE)
class _Zenoh:
    """The table ``[zenoh]``."""

    endpoint: Endpoint = ControllerConfig.endpoint


@dataclass(frozen=True, config=TABLE)
class _ConfigFile:
    """The keys and tables of a configuration file."""

    archive: Path = ControllerConfig.archive
    rig: Path | None = None
    settings: Path | None = None
    live: StrictBool = ControllerConfig.live
    certificates: Path | None = None
    users: Path | None = None
    http: _Http = _Http()
    zenoh: _Zenoh = _Zenoh()


_CONFIG_FILE = TypeAdapter(_ConfigFile)


def read_controller_config(path: Path | None) -> ControllerConfig:
    """Read the configuration in a TOML file; without a file, the defaults.

    Relative paths are taken from the file's folder. Raises InputError, naming the file and the key at fault.
    """
    if path is None:
        return ControllerConfig()
    path = Path(path)
    try:
        file = _CONFIG_FILE.validate_python(tomllib.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such configuration file") from error
    except ValidationError as error:
        raise InputError(f"{path}: {faults(error, _ConfigFile)}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: {error}") from error
    folder = path.resolve().parent
    config = ControllerConfig(
        archive=folder / file.archive,
        live=file.live,
        host=file.http.host,
        port=file.http.port,
        hosts=file.http.hosts,
        endpoint=file.zenoh.endpoint,
    )
    for name in ("rig", "settings", "certificates", "users"):
        if (named := getattr(file, name)) is not None:
            config = replace(config, **{name: folder / named})
    return config
