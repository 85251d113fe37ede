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
WRONG_EXIT = 3
MOST_CAMERAS = 99

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


def init_command(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the rig; a rig.toml in it is kept.")],
    name: Annotated[str | None, typer.Option(help="Name of the rig.")] = None,
    cameras: Annotated[int | None, typer.Option(min=2, max=99, help="Number of cameras, called 01, 02 …")] = None,
    ids: Annotated[str | None, typer.Option(metavar="ID,ID,…", help="Ids of the cameras instead.")] = None,
    first_azimuth: Annotated[float, typer.Option(metavar="DEG", help="Where the first camera stands.")] = 0.0,
    host: Annotated[str | None, typer.Option(metavar="ADDRESS", help="The controller's address for the nodes.")] = None,
    ssh_key: Annotated[Path | None, typer.Option(metavar="FILE", help="Your public key, to log in on nodes.")] = None,
    camera: Annotated[str, typer.Option(help="Kind of camera: pi, or pattern for test images.")] = "pi",
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Write the files of a rig: rig.toml, the controller's configuration, certificates, and a card for each node."""
    from ringdic.session.rig import parse_rig, read_rig

    from ringdic_controller.access.certificates import machines_of, open_authority
    from ringdic_controller.setup import rig_files

    rig_file = folder / "rig.toml"
    if rig_file.is_file():
        rig, text = read_rig(rig_file), None
    else:
        called = _asked(name, "--name", "Name of the rig", "ring-12")
        listed = ids.split(",") if ids else [f"{k:02d}" for k in range(1, _number_of(cameras) + 1)]
        text = rig_files.rig_text(called, [each.strip() for each in listed], first_azimuth)
        rig = parse_rig(text)
    rig_files.check_names(rig)
    host = _asked(host, "--host", "The controller's address on the rig's network", "192.168.1.10")
    answers = rig_files.RigAnswers(host, _public_key(ssh_key), camera)
    now, certificates = datetime.now(UTC), folder / "certificates"
    machines = machines_of(rig.name, [each.id for each in rig.cameras], [host], certificates)
    issue_certificates(open_authority(certificates, rig.name, now), machines, now, yes=yes)
    texts = {rig_file: text} if text else {}
    texts |= {folder / "controller.toml": rig_files.controller_text(answers)}
    texts |= {folder / "inventory.yml": rig_files.inventory_text(rig)}
    for machine in machines[1:]:
        card = folder / "cards" / machine.label / "user-data"
        texts[card] = rig_files.card_text(rig, machine.label, answers, machine.folder)
    written = _write_texts(texts, yes)
    say(f"{len(written)} of {len(texts)} files written in {folder}; a card gets the file of its camera in cards/")
    say("measure target, board and azimuths, set them in rig.toml, then: ringdic rig check " + str(folder))
    if as_json:
        print_json({"folder": str(folder), "written": [str(path) for path in written]})


def check_command(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of a rig, or its controller.toml.")],
    as_json: AsJson = False,
) -> None:
    """Say what is wrong with a rig's files: configuration, certificates, cards, users. Exit code 3 if anything is."""
    from ringdic_controller.setup.rig_check import check_rig

    checks = check_rig(folder / "controller.toml" if folder.is_dir() else folder, datetime.now(UTC))
    for check in checks:
        say(f"WRONG {check.what}: {check.fault}" if check.fault else f"ok    {check.what}")
    if as_json:
        print_json({"checks": [{"what": check.what, "fault": check.fault or None} for check in checks]})
    if any(check.fault for check in checks):
        raise typer.Exit(WRONG_EXIT)


def _write_texts(texts: dict[Path, str], yes: bool) -> list[Path]:
    """Write the files that are missing, and, if somebody agrees, those that differ; the paths that were written."""
    from ringdic_controller.setup.rig_files import write_text

    missing = [path for path in texts if not path.exists()]
    different = [
        path for path, text in texts.items() if path not in missing and path.read_text(encoding="utf-8") != text
    ]
    for path in missing:
        write_text(path, texts[path])
    for path in different:
        say(f"{path} is there already and differs")
    if not different or not (yes or _agreed(f"Replace {len(different)} files?")):
        return missing
    for path in different:
        write_text(path, texts[path])
    return missing + different


def _asked(given: str | None, option: str, question: str, example: str) -> str:
    if given is not None:
        return given
    if not sys.stdin.isatty():
        raise InputError(f"{question} is needed: {option}, like {option} {example}")
    return str(typer.prompt(f"{question} (like {example})", err=True))


def _number_of(cameras: int | None) -> int:
    answer = str(cameras) if cameras else _asked(None, "--cameras", "Number of cameras", "12")
    if not answer.isdecimal() or not 2 <= int(answer) <= MOST_CAMERAS:
        raise InputError(f"'{answer}' is no number of cameras; a rig has 2 to {MOST_CAMERAS}")
    return int(answer)


def _public_key(path: Path | None) -> str:
    """Text of the public key in a file; of the first in ~/.ssh if none is given."""
    usual = sorted((Path.home() / ".ssh").glob("id_*.pub"))
    if path is None and not usual:
        raise InputError("give your public key, by which you log in on the nodes: --ssh-key FILE; ssh-keygen makes one")
    chosen = path or usual[0]
    try:
        return chosen.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{chosen} cannot be read as a public key ({error}); give another with --ssh-key") from error


RIG_COMMANDS: dict[str, Callable[..., None]] = {
    "certificates": certificates_command,
    "init": init_command,
    "check": check_command,
}
