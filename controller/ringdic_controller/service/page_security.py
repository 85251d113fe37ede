"""What the page needs before it is served: on another address than loopback, certificates and users."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ringdic.errors import InputError
from ringdic_node.endpoint import CERTIFICATE, KEY, EndpointError, check_certificates, is_loopback

from ringdic_controller.access.audit import AUDIT_FILE, AuditLog
from ringdic_controller.access.logins import Logins
from ringdic_controller.access.users import UserFile
from ringdic_controller.service.config import ControllerConfig
from ringdic_controller.service.gate import Access


@dataclass(frozen=True)
class PageSecurity:
    """How the page is served. scheme : http or https. server_settings : arguments of uvicorn's configuration."""

    access: Access
    scheme: str = "http"
    server_settings: dict[str, Any] = field(default_factory=dict)


def page_security(config: ControllerConfig) -> PageSecurity:
    """How the page of a configuration is served; raises InputError where others reach it without protection.

    On loopback the page is plain HTTP, and asks for a login only if the configuration names users.
    """
    access = Access(AuditLog(config.archive / AUDIT_FILE), _logins(config))
    # What a client says of itself in X-Forwarded-For is not believed: the audit log and the limits go by addresses.
    plain: dict[str, Any] = {"proxy_headers": False}
    if is_loopback(config.host):
        return PageSecurity(access, "http", plain)
    if config.certificates is None or access.logins is None:
        raise InputError(
            f'the page at [http] host = "{config.host}" would be open to other machines without certificates and '
            "login: make certificates with 'ringdic rig certificates rig.toml --host ADDRESS' and users with "
            "'ringdic users add NAME', and name both in the controller's configuration as certificates = "
            '"certificates/controller" and users = "users.json"; or leave the page on 127.0.0.1'
        )
    try:
        check_certificates(config.certificates)
    except EndpointError as error:
        raise InputError(str(error)) from error
    files = {
        "ssl_certfile": str(config.certificates / CERTIFICATE),
        "ssl_keyfile": str(config.certificates / KEY),
    }
    return PageSecurity(access, "https", {**plain, **files})


def _logins(config: ControllerConfig) -> Logins | None:
    """The logins of the configuration's users; None if it names no file of them. Raises InputError for an empty one."""
    if config.users is None:
        return None
    users = UserFile(config.users)
    if not users.rows():
        raise InputError(f"{config.users} names nobody, so that nobody could log in; add one: ringdic users add NAME")
    return Logins(users)
