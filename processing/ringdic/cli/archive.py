"""The commands ``ringdic archive …``: verify the sessions of an archive, back them up, remove what is backed up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ringdic.cli.console import print_json, say
from ringdic.cli.options import AsJson
from ringdic.errors import InputError

archive_app = typer.Typer(
    name="archive", help="Verify the sessions of an archive, back them up, remove old ones.", no_args_is_help=True
)

Folder = Annotated[Path, typer.Argument(metavar="ARCHIVE", help="A folder of sessions.")]
Backup = Annotated[Path, typer.Argument(metavar="BACKUP", help="Folder of the backup, on another disk.")]
_FAULTY_EXIT = 3


@archive_app.command("verify")
def verify_command(
    archive: Annotated[Path, typer.Argument(metavar="ARCHIVE", help="A folder of sessions, or one session.")],
    as_json: AsJson = False,
) -> None:
    """Read every archived image and hold it against its checksum; ends with exit code 3 where one is not as it was."""
    from ringdic.session.verification import session_folders, verify_session

    folders = (archive,) if (archive / "session.json").is_file() else session_folders(archive)
    if not folders:
        raise InputError(f"{archive}: no session is in this folder")
    checked = []
    for folder in folders:
        each = verify_session(folder)
        checked.append(each)
        if not as_json:
            say(f"{folder.name}: {each.images} images of {each.size / 1e6:.1f} MB are as archived")
            for sentence in (*each.faults.values(), *each.notes):
                say(f"  {sentence}")
    faults = [fault for each in checked for fault in each.faults.values()]
    if as_json:
        notes = [note for each in checked for note in each.notes]
        images = sum(each.images for each in checked)
        print_json({"sessions": len(checked), "images": images, "faults": faults, "notes": notes})
    if faults:
        raise typer.Exit(_FAULTY_EXIT)


@archive_app.command("backup")
def backup_command(archive: Folder, backup: Backup, as_json: AsJson = False) -> None:
    """Copy what the backup lacks, verified; ends with exit code 3 where something could not be copied.

    Nothing in the backup is replaced but records.
    """
    from ringdic.session.backup import back_up

    copied = faults = 0
    sentences: list[str] = []
    for done in back_up(archive, backup):
        copied, faults = copied + done.copied, faults + len(done.faults)
        sentences += done.faults
        if not as_json:
            say(f"{done.session}: {done.copied} files copied ({done.size / 1e6:.1f} MB), {done.held} held already")
            for sentence in done.faults:
                say(f"  {sentence}")
    if as_json:
        print_json({"copied": copied, "faults": sentences})
    if faults:
        raise typer.Exit(_FAULTY_EXIT)


@archive_app.command("prune")
def prune_command(
    archive: Folder,
    backup: Backup,
    older_than: Annotated[float, typer.Option(min=0, metavar="DAYS", help="Days without a change.")] = 365.0,
    yes: Annotated[bool, typer.Option("--yes", help="Remove them; without it they are only listed.")] = False,
    as_json: AsJson = False,
) -> None:
    """Remove sessions that have not changed for a time and that the backup holds, byte for byte."""
    from ringdic.session.backup import removable_sessions, remove_session

    found = removable_sessions(archive, backup, older_than)
    may_go = [session for session, reason in found if not reason]
    if yes:
        for session in may_go:
            remove_session(session)
    if as_json:
        kept = {session.name: reason for session, reason in found if reason}
        print_json({"removable": [session.name for session in may_go], "removed": yes, "kept": kept})
        return
    done = "removed" if yes else "may go"
    for session, reason in found:
        say(f"{session.name}: {f'stays: {reason}' if reason else done}")
    if may_go and not yes:
        say("nothing was removed; --yes removes them")
