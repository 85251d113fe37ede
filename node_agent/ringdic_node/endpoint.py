"""The endpoint that joins node and controller: whom it lets in, and the certificates that both sides need for it.

Every machine of a rig has a folder with three files, which ``ringdic rig certificates`` makes::

    authority.pem     certificate of the rig's authority, the same on every machine
    certificate.pem   certificate of this machine, which names the rig and the node
    key.pem           private key to it; readable by the service alone

An endpoint on loopback may do without them. Standard library only; the controller imports this module too.
"""

from __future__ import annotations

import ipaddress
import socket
import ssl
from pathlib import Path

AUTHORITY = "authority.pem"
CERTIFICATE = "certificate.pem"
KEY = "key.pem"


class EndpointError(ValueError):
    """The endpoint may not be used like this, or its certificates cannot; the text says how to mend that."""


def controller_name(rig: str) -> str:
    """Common name of the controller's certificate."""
    return f"{rig}/controller"


def node_name(rig: str, node: str) -> str:
    """Common name of a node's certificate, by which it is known."""
    return f"{rig}/node/{node}"


def endpoint_host(endpoint: str) -> str:
    """Host of a Zenoh endpoint: ``192.168.1.10`` of ``tls/192.168.1.10:7447#…``, ``::1`` of ``tcp/[::1]:7447``."""
    address = endpoint.partition("/")[2].partition("#")[0].partition("?")[0]
    return address.rpartition(":")[0].strip("[]")


def is_loopback(host: str) -> bool:
    """Whether an address is reached from this machine alone; a name other than ``localhost`` counts as reached."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def endpoint_security(endpoint: str, certificates: Path | None) -> dict[str, object]:
    """Zenoh's settings for an endpoint with certificates; empty for one without, which is on loopback.

    Parameters
    ----------
    endpoint
        Where nodes connect, like ``tls/192.168.1.10:7447``.
    certificates
        Folder with the three files of this machine; None if there is none.

    Raises EndpointError for a plain endpoint that other machines reach, and for files that cannot be used.
    """
    protocol = endpoint.partition("/")[0]
    if protocol != "tls":
        if is_loopback(endpoint_host(endpoint)):
            return {}
        raise EndpointError(
            f"the endpoint '{endpoint}' reaches other machines without certificates, so that anyone there could "
            "capture, send images and delete them: make certificates with 'ringdic rig certificates rig.toml --host "
            "ADDRESS', put this machine's folder of them beside this configuration, name it there as "
            'certificates = "FOLDER", and write the endpoint as '
            f"'tls/{endpoint.partition('/')[2]}'"
        )
    if certificates is None:
        raise EndpointError(
            f"the endpoint '{endpoint}' needs certificates: make them with 'ringdic rig certificates rig.toml "
            "--host ADDRESS' and name this machine's folder of them as certificates = \"FOLDER\" in the configuration"
        )
    check_certificates(certificates)
    authority, certificate, key = (str(certificates / name) for name in (AUTHORITY, CERTIFICATE, KEY))
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": authority,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        },
    }


def check_certificates(folder: Path) -> None:
    """Raise EndpointError unless the three files of a machine can be read and the key is the certificate's."""
    for name in (AUTHORITY, CERTIFICATE, KEY):
        try:
            (folder / name).read_bytes()
        except OSError as error:
            raise EndpointError(
                f"{folder / name} cannot be read ({error.strerror}); 'ringdic rig certificates' makes it, and the user "
                "of the service must be allowed to read it"
            ) from error
    try:
        client_context(folder)
    except ssl.SSLError as error:
        raise EndpointError(
            f"the certificates in {folder} cannot be used ({error.reason or error}); key.pem must belong to "
            "certificate.pem: make both anew with 'ringdic rig certificates --renew'"
        ) from error


def client_context(folder: Path) -> ssl.SSLContext:
    """TLS settings of the standard library for this machine as a client. Raises ssl.SSLError for unusable files."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(folder / AUTHORITY)
    context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    return context


def handshake_fault(endpoint: str, certificates: Path, timeout: float = 1.0) -> str | None:
    """Why the controller and this machine do not accept each other's certificates; None if they do, or nobody answers.

    timeout : s that either side may take.
    """
    host, port = endpoint_host(endpoint), endpoint.partition("#")[0].rpartition(":")[2]
    if not endpoint.startswith("tls/"):
        return None
    try:
        with (
            socket.create_connection((host, int(port)), timeout) as plain,
            client_context(certificates).wrap_socket(plain, server_hostname=host) as secured,
        ):
            secured.recv(1)  # only now it tells whether it has accepted this machine's certificate
    except ssl.SSLCertVerificationError as error:
        return f"the controller's: {error.verify_message}; is this machine's clock right?"
    except ssl.SSLError as error:
        words = (error.reason or str(error)).lower().replace("_", " ")
        return f"this machine's is refused ({words}); 'ringdic rig check' on the controller tells why"
    except OSError:
        return None
    return None
