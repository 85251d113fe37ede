"""An archive is verified image by image; a backup holds it byte for byte; only what it holds can be removed."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from ringdic.errors import InputError
from ringdic.session.backup import back_up, removable_sessions, remove_session
from ringdic.session.folder import open_session
from ringdic.session.records import ImageDescription
from ringdic.session.verification import verify_session
from ringdic.session.writer import Archive

RigText = Callable[[str, Sequence[str]], str]
DAY = 86_400


def image(camera: str, number: int) -> bytes:
    return b"P5 4 3 255 " + bytes([int(camera) % 256, number] * 6)


@pytest.fixture
def archive(tmp_path: Path, rig_toml: RigText) -> Path:
    """Two sessions of two captures by two cameras."""
    writer = Archive(tmp_path / "archive")
    for name in ("first", "second"):
        session = writer.create_session(name, rig_toml("ring", ["201", "202"]))
        for number in (1, 2):
            capture = session.begin_capture("specimen", ["201", "202"], fire_at_ns=number, tolerance_ns=1000)
            for camera in ("201", "202"):
                content = image(camera, number)
                capture.store(camera, ImageDescription(hashlib.sha256(content).hexdigest(), 4, 3, number), content)
            capture.close({})
    return tmp_path / "archive"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_was_archived_is_verified_image_by_image(archive: Path) -> None:
    before = contents(archive)
    verified = verify_session(archive / "first")
    assert (verified.images, verified.size) == (4, 4 * 23)
    assert not verified.faults
    assert not verified.notes
    assert contents(archive) == before


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda image: image.unlink(), "201.pgm: the image of camera 201 in 0002-specimen is not there"),
        (lambda image: image.write_bytes(image.read_bytes()[:-1]), "22 bytes instead of 23"),
        (lambda image: image.write_bytes(image.read_bytes()[:-1] + b"!"), "its checksum is not the archived one"),
        (lambda image: (image.parent / "capture.json").write_text("{"), "not readable as JSON"),
        (lambda image: (image.unlink(), image.symlink_to("202.pgm")), "is not there"),
    ],
)
def test_each_damage_is_named_and_the_rest_still_verified(archive: Path, damage: object, sentence: str) -> None:
    damage(archive / "first" / "captures" / "0002-specimen" / "201.pgm")  # type: ignore[operator]
    verified = verify_session(archive / "first")
    (fault,) = verified.faults.values()
    assert sentence in fault
    assert verified.images in (2, 3)


def test_a_file_that_no_record_names_is_noted(archive: Path) -> None:
    folder = archive / "first" / "captures" / "0001-specimen"
    (folder / "201.conflict-1.pgm").write_bytes(b"another")
    verified = verify_session(archive / "first")
    assert not verified.faults
    assert [note.split(": ")[0] for note in verified.notes] == [str(folder / "201.conflict-1.pgm")]


def test_a_backup_is_an_archive_of_the_same_bytes_and_a_second_one_copies_nothing(
    archive: Path, tmp_path: Path
) -> None:
    (archive / "first" / "work").mkdir()
    (archive / "first" / "work" / "heavy.npz").write_bytes(b"computed")
    backup = tmp_path / "backup"
    done = list(back_up(archive, backup))
    assert [each.session for each in done] == ["first", "second"]
    assert not any(each.faults for each in done)
    expected = {name: content for name, content in contents(archive).items() if "/work/" not in name}
    assert contents(backup) == expected
    assert len(open_session(backup / "second").captures) == 2
    assert sum(each.copied for each in back_up(archive, backup)) == 0


def test_an_interrupted_backup_goes_on_and_a_changed_record_follows(archive: Path, tmp_path: Path) -> None:
    backup = tmp_path / "backup"
    next(iter(back_up(archive, backup)))  # the second session is not reached
    record = archive / "first" / "captures" / "0001-specimen" / "capture.json"
    document = json.loads(record.read_text())
    document["cameras"]["201"]["metadata"] = {"note": "added later"}
    record.write_text(json.dumps(document))
    assert not any(each.faults for each in back_up(archive, backup))
    assert contents(backup) == contents(archive)


def test_damage_does_not_spread_into_a_backup(archive: Path, tmp_path: Path) -> None:
    backup = tmp_path / "backup"
    list(back_up(archive, backup))
    spoilt = archive / "first" / "captures" / "0001-specimen" / "201.pgm"
    good = spoilt.read_bytes()
    spoilt.write_bytes(b"X" * len(good))
    first, _ = back_up(archive, backup)
    assert any("checksum" in fault for fault in first.faults)
    assert (backup / "first" / "captures" / "0001-specimen" / "201.pgm").read_bytes() == good


def test_an_image_that_differs_from_the_backups_is_named_and_not_replaced(archive: Path, tmp_path: Path) -> None:
    backup = tmp_path / "backup"
    list(back_up(archive, backup))
    held = backup / "second" / "captures" / "0002-specimen" / "202.pgm"
    held.write_bytes(b"of another session with the same name")
    _, second = back_up(archive, backup)
    assert [str(held) in fault for fault in second.faults] == [True]
    assert held.read_bytes() == b"of another session with the same name"


def test_links_are_not_followed_out_of_the_archive(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "private").mkdir()
    (tmp_path / "private" / "secret.txt").write_text("secret")
    (archive / "first" / "results").symlink_to(tmp_path / "private")
    (archive / "third").symlink_to(archive / "first")
    (archive / "first" / "mask").mkdir()
    (archive / "first" / "mask" / "201.png").symlink_to(tmp_path / "private" / "secret.txt")
    done = list(back_up(archive, tmp_path / "backup"))
    assert [each.session for each in done] == ["first", "second"]
    assert b"secret" not in b"".join(contents(tmp_path / "backup").values())


def aged(session: Path, days: float) -> None:
    for path in session.rglob("*"):
        moment = path.stat().st_mtime - days * DAY
        os.utime(path, (moment, moment))


def test_only_old_sessions_that_the_backup_holds_may_go(archive: Path, tmp_path: Path) -> None:
    backup = tmp_path / "backup"
    aged(archive / "first", 400)
    assert removable_sessions(archive, backup, 500) == ()
    ((session, reason),) = removable_sessions(archive, backup, 365)
    assert session.name == "first"
    assert "the backup lacks" in reason
    list(back_up(archive, backup))
    assert [(each.name, why) for each, why in removable_sessions(archive, backup, 365)] == [("first", "")]
    (backup / "first" / "captures" / "0001-specimen" / "201.pgm").write_bytes(b"rotten")
    ((_, reason),) = removable_sessions(archive, backup, 365)
    assert "is another one" in reason


def test_a_session_is_removed_as_a_whole(archive: Path) -> None:
    remove_session(archive / "first")
    assert [path.name for path in archive.iterdir()] == ["second"]


def test_a_backup_in_the_archive_is_refused(archive: Path) -> None:
    for backup in (archive, archive / "backup", archive.parent):
        with pytest.raises(InputError, match="must not lie in"):
            list(back_up(archive, backup))


def test_the_commands_end_with_the_code_that_scripts_read(archive: Path, tmp_path: Path) -> None:
    from ringdic.cli.app import application
    from typer.testing import CliRunner

    def code(*arguments: object) -> int:
        return CliRunner().invoke(application(), ["archive", *map(str, arguments)]).exit_code

    backup = tmp_path / "backup"
    assert code("verify", archive) == code("backup", archive, backup) == code("verify", backup) == 0
    assert code("prune", archive, backup, "--older-than", 0, "--json") == 0
    assert (archive / "first").is_dir()
    shutil.rmtree(archive / "second" / "captures" / "0001-specimen")
    assert code("verify", archive / "second") == 0  # what is not there at all cannot be missed
    (archive / "first" / "captures" / "0001-specimen" / "201.pgm").unlink()
    assert code("verify", archive) == code("backup", archive, backup) == 3
    assert code("prune", archive, backup, "--older-than", 0, "--yes") == 0
    assert sorted(path.name for path in archive.iterdir()) == ["first"]


def test_a_second_image_that_a_record_names_is_verified_like_the_first(archive: Path) -> None:
    capture = Archive(archive).open("first").capture("0001-specimen")
    other = b"another"
    capture.store("201", ImageDescription(hashlib.sha256(other).hexdigest(), 4, 3, 1), other)
    verified = verify_session(archive / "first")
    assert (verified.images, verified.faults, verified.notes) == (5, {}, ())
    aside = capture.path / "201.conflict-1.pgm"
    aside.write_bytes(b"anothe!")
    assert list(verify_session(archive / "first").faults) == [aside]
