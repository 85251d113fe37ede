"""The rig's certificate authority, and the certificates of the controller and the nodes that it signs.

A folder of certificates::

    authority.pem, authority.key    the authority; its key signs, and is needed by no machine of the rig
    controller/                     the three files of `ringdic_node.endpoint`, for the controller
    nodes/<id>/                     these files for each node

The common name tells who a machine is, and access is granted by it: ``RIG/controller`` or ``RIG/node/ID``. A node's
certificate serves to connect only, so that it cannot pass for the controller. Keys are elliptic (P-256).
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from ringdic.errors import InputError
from ringdic_node.endpoint import AUTHORITY, CERTIFICATE, KEY, controller_name, node_name

AUTHORITY_KEY = "authority.key"
AUTHORITY_LIFE = timedelta(days=3653)
MACHINE_LIFE = timedelta(days=730)
# A Pi has no clock that runs without power: at its first boot it believes that it is weeks ago. Browsers refuse
# certificates that are valid for more than 825 days in all.
BACKDATED = timedelta(days=90)
RENEW_WITHIN = timedelta(days=60)
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
LONGEST_NAME = 64  # characters of a common name


@dataclass(frozen=True)
class RigMachine:
    """A machine of a rig and the folder of its certificate. hosts : names and addresses that others reach it by."""

    label: str
    common_name: str
    folder: Path
    hosts: tuple[str, ...] = ()

    def certificate(self) -> x509.Certificate | None:
        """The machine's present certificate; None if there is none. Raises InputError if it cannot be read."""
        return _read_certificate(self.folder / CERTIFICATE)


@dataclass(frozen=True)
class Authority:
    """A rig's certificate authority with its private key, able to sign."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @staticmethod
    def create(rig: str, now: datetime) -> Authority:
        """A new authority for a rig, named after it."""
        key = ec.generate_private_key(ec.SECP256R1())
        name = _common_name(f"{rig}/authority")
        builder = _builder(name, name, key.public_key(), now - BACKDATED, now + AUTHORITY_LIFE)
        usage = {name: name in ("key_cert_sign", "crl_sign") for name in _USAGES}
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        builder = builder.add_extension(x509.KeyUsage(**usage), critical=True)
        return Authority(builder.sign(key, hashes.SHA256()), key)

    def sign(
        self, machine: RigMachine, key: ec.EllipticCurvePublicKey, now: datetime, life: timedelta = MACHINE_LIFE
    ) -> x509.Certificate:
        """The certificate of a machine with this public key, valid from a while before ``now``, for ``life`` after."""
        builder = _builder(
            _common_name(machine.common_name), self.certificate.subject, key, now - BACKDATED, now + life
        )
        usage = {name: name == "digital_signature" for name in _USAGES}
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if machine.hosts:
            purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
            builder = builder.add_extension(
                x509.SubjectAlternativeName([_general_name(host) for host in machine.hosts]), critical=False
            )
        authority = x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key())
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        builder = builder.add_extension(x509.KeyUsage(**usage), critical=True)
        builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        builder = builder.add_extension(authority, critical=False)
        return builder.sign(self.key, hashes.SHA256())

    def issue(self, machine: RigMachine, now: datetime, life: timedelta = MACHINE_LIFE) -> None:
        """Write the three files of a machine with a new key; files that are there are replaced."""
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = self.sign(machine, key.public_key(), now, life)
        machine.folder.mkdir(parents=True, exist_ok=True)
        # The certificate last: where this is interrupted, `machine_fault` finds that it does not belong to the key.
        _write(machine.folder / KEY, _key_bytes(key), 0o600)
        _write(machine.folder / AUTHORITY, _pem(self.certificate), 0o644)
        _write(machine.folder / CERTIFICATE, _pem(certificate), 0o644)


def machine_fault(machine: RigMachine, now: datetime, authority: x509.Certificate | None = None) -> str | None:
    """What is wrong with a machine's certificate, None if nothing is; ``"is missing"`` if there is none.

    authority : certificate of the authority; None for the one beside the machine's. Raises InputError for a file that
    is no certificate.
    """
    certificate = machine.certificate()
    authority = authority or _read_certificate(machine.folder / AUTHORITY)
    if certificate is None or authority is None:
        return "is missing, beside a key" if (machine.folder / KEY).exists() else "is missing"
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return "is signed by another authority"
    if common_name_of(certificate) != machine.common_name:
        return f"names {common_name_of(certificate)}"
    if _read_public_key(machine.folder / KEY) != certificate.public_key():
        return "does not belong to the key beside it"
    absent = sorted(set(machine.hosts) - set(hosts_of(certificate)))
    if absent:
        return f"does not name {', '.join(absent)}"
    left = certificate.not_valid_after_utc - now
    if left <= timedelta(0):
        return f"has expired on {certificate.not_valid_after_utc:%Y-%m-%d}"
    return f"expires in {left.days} days" if left < RENEW_WITHIN else None


def open_authority(folder: Path, rig: str, now: datetime) -> Authority:
    """The authority in a folder, created there if the folder has none. Raises InputError if it is another rig's."""
    certificate, key_path = _read_certificate(folder / AUTHORITY), folder / AUTHORITY_KEY
    if certificate is None and not key_path.exists():
        authority = Authority.create(rig, now)
        folder.mkdir(parents=True, exist_ok=True)
        _write(key_path, _key_bytes(authority.key), 0o600)
        _write(folder / AUTHORITY, _pem(authority.certificate), 0o644)
        return authority
    if certificate is None or not key_path.exists():
        missing = folder / AUTHORITY if certificate is None else key_path
        raise InputError(f"{missing} is missing; put it back, or make all certificates anew in another folder")
    if common_name_of(certificate) != f"{rig}/authority":
        raise InputError(
            f"{folder / AUTHORITY} is the authority '{common_name_of(certificate)}', not that of the rig '{rig}'; "
            "use another folder for each rig"
        )
    if certificate.not_valid_after_utc <= now:
        raise InputError(
            f"the authority in {folder} has expired on {certificate.not_valid_after_utc:%Y-%m-%d}; make all "
            "certificates anew in another folder, and replace them on every machine"
        )
    try:
        key = serialization.load_pem_private_key(key_path.read_bytes(), None)
    except (ValueError, TypeError) as error:
        raise InputError(f"{key_path} is no private key in PEM form; put the right file back") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise InputError(f"{key_path} is not the key of {folder / AUTHORITY}; put the right file back")
    return Authority(certificate, key)


def machines_of(rig: str, nodes: Iterable[str], hosts: Sequence[str], folder: Path) -> list[RigMachine]:
    """The machines of a rig: the controller, then the nodes.

    hosts : names and addresses that the nodes and browsers reach the controller by; those of its present certificate
    if there are none. Raises InputError for names that are too long for a certificate, and if no host is known.
    """
    controller = RigMachine("controller", controller_name(rig), folder / "controller")
    present = controller.certificate()
    known = list(hosts) or [host for host in (hosts_of(present) if present else []) if host not in LOCAL_HOSTS]
    if not known:
        raise InputError("give the controller's address on the rig's network with --host, like --host 192.168.1.10")
    controller = RigMachine("controller", controller.common_name, controller.folder, tuple(dict.fromkeys(
        [_checked_host(host) for host in known] + list(LOCAL_HOSTS)
    )))  # fmt: skip
    machines = [controller] + [RigMachine(id_, node_name(rig, id_), folder / "nodes" / id_) for id_ in nodes]
    for machine in machines:
        if len(machine.common_name) > LONGEST_NAME:
            raise InputError(
                f"'{machine.common_name}' is longer than the {LONGEST_NAME} characters that a certificate may name; "
                "shorten the name of the rig or the id of the camera"
            )
    return machines


def common_name_of(certificate: x509.Certificate) -> str:
    """The common name in a certificate."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def hosts_of(certificate: x509.Certificate) -> list[str]:
    """The names and addresses that a certificate is for; empty for a node's."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return []
    addresses = [str(address) for address in names.get_values_for_type(x509.IPAddress)]
    return [*names.get_values_for_type(x509.DNSName), *addresses]


_USAGES = (
    "digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_agreement",
    "key_cert_sign", "crl_sign", "encipher_only", "decipher_only",
)  # fmt: skip


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, start: datetime, end: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(start.astimezone(UTC))
        .not_valid_after(end.astimezone(UTC))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _common_name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _checked_host(host: str) -> str:
    try:
        return str(ipaddress.ip_address(host))
    except ValueError:
        pass
    name = host.lower().rstrip(".")
    labels = name.split(".")
    if not all(label and label.replace("-", "").isalnum() and label.isascii() for label in labels):
        raise InputError(f"--host '{host}' is neither an address nor a host's name; give it without port and protocol")
    return name


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _read_certificate(path: Path) -> x509.Certificate | None:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise InputError(f"{path} is no certificate in PEM form; remove it, and it is made anew") from error


def _read_public_key(path: Path) -> object | None:
    try:
        return serialization.load_pem_private_key(path.read_bytes(), None).public_key()
    except (FileNotFoundError, ValueError, TypeError):
        return None


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_bytes(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write(path: Path, content: bytes, mode: int) -> None:
    """Replace a file in one step; the new one never has a wider mode, not even for a moment."""
    partial = path.with_name(f".{path.name}.new")
    partial.unlink(missing_ok=True)
    descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)
