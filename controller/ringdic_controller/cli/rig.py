"""The commands ``ringdic rig …`` of the controller's package: what a rig needs before it can capture."""

from __future__ import annotations

import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from ringdic.cli.console import print_json, say, show_table
from ringdic.cli.options import AsJson
from ringdic.errors import InputError

if TYPE_CHECKING:
    from ringdic_controller.access.certificates import Authority, RigMachine

RigFile = Annotated[Path, typer.Argument(metavar="RIG", help="The file rig.toml, or the folder that holds it.")]
Hosts = Annotated[
    list[str] | None,
    typer.Option("--host", metavar="ADDRESS", help="The controller's address on the rig's network. Repeatable."),
]
Yes = Annotated[bool, typer.Option("--yes", help="Replace files without asking.")]


def certificates_command(
    rig: RigFile,
    hosts: Hosts = None,
    out: Annotated[Path, typer.Option(help="Folder of the authority and of all certificates.")] = Path("certificates"),
    renew: Annotated[bool, typer.Option("--renew", help="Make every machine's certificate anew.")] = False,
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Make the rig's authority and the certificates of the controller and of each node; keep those that are sound."""
    from ringdic.session.rig import read_rig

    from ringdic_controller.access.certificates import machines_of, open_authority

    described = read_rig(rig / "rig.toml" if rig.is_dir() else rig)
    now = datetime.now(UTC)
    machines = machines_of(described.name, [camera.id for camera in described.cameras], hosts or [], out)
    authority = open_authority(out, described.name, now)
    states = issue_certificates(authority, machines, now, renew=renew, yes=yes)
    rows = [
        {
            "machine": machine.label,
            "folder": str(machine.folder),
            "valid until": _end(machine),
            "": states[machine.label],
        }
        for machine in machines
    ]
    show_table(f"certificates of the rig {described.name}", rows)
    say(f"keep {out / 'authority.key'} away from the rig and from the network: it lets anyone in")
    if as_json:
        names = ("machine", "folder", "valid_until", "state")
        print_json({"machines": [dict(zip(names, row.values(), strict=True)) for row in rows]})


def issue_certificates(
    authority: Authority, machines: list[RigMachine], now: datetime, *, renew: bool = False, yes: bool = False
) -> dict[str, str]:
    """Make what is missing, and replace what is at fault; what was done, or is wrong, by the label of the machine.

    renew : replace all that is there. yes : replace without asking. Raises InputError where nobody can be asked.
    """
    from ringdic_controller.access.certificates import machine_fault

    faults = {machine.label: machine_fault(machine, now, authority.certificate) for machine in machines}
    missing = [machine for machine in machines if faults[machine.label] == "is missing"]
    present = [machine for machine in machines if machine not in missing]
    wrong = [machine for machine in present if renew or faults[machine.label]]
    for machine in missing:
        authority.issue(machine, now)
    states = {machine.label: "kept" for machine in present} | {machine.label: "made" for machine in missing}
    for machine in wrong:
        say(f"{machine.label}: the certificate {faults[machine.label] or 'is sound, and is to be renewed'}")
    if wrong and (yes or _agreed(f"Replace {len(wrong)} of {len(machines)} certificates and their keys?")):
        for machine in wrong:
            authority.issue(machine, now)
            states[machine.label] = "renewed"
    elif wrong:
        states |= {machine.label: f"kept: {faults[machine.label] or 'sound'}" for machine in wrong}
    return states


def _agreed(question: str) -> bool:
    if not sys.stdin.isatty():
        raise InputError(f"{question} Nobody is there to answer: nothing was replaced; add --yes to replace")
    return typer.confirm(question, err=True)


def _end(machine: RigMachine) -> str:
    certificate = machine.certificate()
    return f"{certificate.not_valid_after_utc:%Y-%m-%d}" if certificate else "–"


RIG_COMMANDS: dict[str, Callable[..., None]] = {"certificates": certificates_command}
