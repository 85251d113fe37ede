"""The spool: what is committed survives, what is not does not count, and only the right hash frees."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace

import pytest
from ringdic_node import spool as spool_module
from ringdic_node.image_file import image_digest
from ringdic_node.spool import Spool, SpoolError
from ringdic_node.wire import CaptureKey, Manifest, decode, encode

PARTS = (b"P5\n3 2\n255\n", b"abcdef")


def manifest_of(capture: str = "0001-board", parts=PARTS) -> Manifest:
    sha256, length = image_digest(parts)
    return Manifest("n", CaptureKey("s", capture, 5), "board", sha256, length, 3, 2, 6)


def claimed(folder) -> Spool:
    """A spool as a starting node finds it."""
    spool = Spool(folder)
    spool.claim()
    return spool


def test_a_spool_belongs_to_one_process(tmp_path):
    first = claimed(tmp_path)
    (tmp_path / ".partial-x.pgm").write_bytes(b"being written")
    with pytest.raises(SpoolError, match="in use"):
        claimed(tmp_path)
    assert Spool(tmp_path).free > 0
    assert (tmp_path / ".partial-x.pgm").exists(), "who does not own the spool sweeps nothing"
    first.release()
    claimed(tmp_path).release()
    assert not (tmp_path / ".partial-x.pgm").exists()


def test_a_stored_image_survives_a_restart(tmp_path):
    manifest = manifest_of()
    Spool(tmp_path).store(manifest, PARTS)
    again = claimed(tmp_path)
    assert again.manifests() == [manifest]
    assert again.read(manifest.key) == b"".join(PARTS)


@pytest.mark.parametrize("steps", range(6))
def test_a_power_cut_at_any_step_leaves_all_or_nothing(tmp_path, monkeypatch, steps):
    """The disk's operations are cut off after so many of them."""
    left = [steps]

    def cut(operation):
        def act(*arguments):
            if left[0] == 0:
                raise KeyboardInterrupt
            left[0] -= 1
            return operation(*arguments)

        return act

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", cut(os.fsync))
        patch.setattr(os, "replace", cut(os.replace))
        try:
            Spool(tmp_path).store(manifest_of(), PARTS)
            finished = True
        except KeyboardInterrupt:
            finished = False
    again = claimed(tmp_path)
    held = again.manifests()
    assert held in ([], [manifest_of()])
    if finished:
        assert held
    for manifest in held:
        assert image_digest([again.read(manifest.key)]) == (manifest.sha256, manifest.bytes)
    committed = len(held)
    assert len([p for p in tmp_path.iterdir() if p.name != ".claim"]) == 2 * committed, "nothing half-written is left"
    assert committed or steps < 2, "an image that reached the disk with its manifest is there again"


def test_only_its_own_hash_delivers_an_image_and_a_note_stays(tmp_path):
    spool, manifest = Spool(tmp_path, keep=0), manifest_of()
    spool.store(manifest, PARTS)
    assert spool.deliver(manifest.key, "0" * 64) is False
    assert spool.manifests() == [manifest]
    assert spool.deliver(manifest.key, manifest.sha256) is True
    assert spool.deliver(manifest.key, manifest.sha256) is False
    assert spool.take_removed() == [manifest.key]
    again = Spool(tmp_path)
    assert again.contents().waiting == again.contents().delivered == ()
    assert again.tombstones() == [manifest.key]
    with pytest.raises(SpoolError, match="already"):
        again.store(manifest, PARTS)


def test_a_delivered_image_is_held_until_its_room_is_needed(tmp_path, monkeypatch):
    """An acknowledgement may be forged: what the controller asks for again is still there."""
    disk = [10 << 20]
    monkeypatch.setattr(spool_module.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(0, 0, disk[0]))
    spool = Spool(tmp_path, reserve=0)
    manifests = [manifest_of(f"{n:04d}-board") for n in (1, 2, 3)]
    for manifest in manifests:
        spool.store(manifest, PARTS)
    for manifest in manifests[:2]:
        spool.deliver(manifest.key, manifest.sha256)
    again = claimed(tmp_path)
    assert list(again.contents().delivered) == manifests[:2]
    assert again.read(manifests[0].key) == b"".join(PARTS)

    def shrinking(path, *_, unlink=os.unlink):
        disk[0] += 40 << 10  # what a removal gives back
        unlink(path)

    spool, disk[0] = Spool(tmp_path, reserve=0), 0
    monkeypatch.setattr(os, "unlink", shrinking)
    free = spool.free
    assert free == 2 * manifests[0].bytes, "its room counts as free"
    monkeypatch.setattr(spool_module, "FILE_COST", 0)
    spool.store(manifest_of("0004-board"), PARTS)
    assert spool.take_removed() == [manifests[0].key], "the one that was delivered first"
    assert [m.key.capture_id for m in spool.contents().delivered] == ["0002-board"]
    assert manifests[0].key in spool.tombstones()


def test_what_is_kept_of_delivered_images_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(spool_module, "TOMBSTONES_KEPT", 3)
    spool = Spool(tmp_path, keep=2 * manifest_of().bytes)
    for n in range(10):
        manifest = manifest_of(f"{n:04d}-board")
        spool.store(manifest, PARTS)
        assert spool.deliver(manifest.key, manifest.sha256)
        assert len(list(tmp_path.iterdir())) <= 3 * 2 + 3, "while it runs, not only at the next start"
    assert [m.key.capture_id for m in spool.contents().delivered] == ["0008-board", "0009-board"]


def test_a_disk_that_fills_while_an_image_is_written_leaves_no_files(tmp_path, monkeypatch):
    spool = claimed(tmp_path)

    def full(_):
        raise OSError(28, "No space left on device")

    for fails in (1, 2):
        calls = iter([lambda _: None] * (fails - 1) + [full] * 9)
        monkeypatch.setattr(os, "fsync", lambda fd, calls=calls: next(calls)(fd))
        with pytest.raises(SpoolError, match="No space"):
            spool.store(manifest_of(), PARTS)
        assert [path.name for path in tmp_path.iterdir()] == [".claim"]


def test_a_second_image_of_a_capture_is_refused(tmp_path):
    spool = Spool(tmp_path)
    spool.store(manifest_of(), PARTS)
    with pytest.raises(SpoolError, match="already"):
        spool.store(manifest_of(), PARTS)


def test_a_full_disk_is_told_before_anything_is_written(tmp_path):
    spool = Spool(tmp_path, reserve=1 << 62)
    assert spool.free == 0
    with pytest.raises(SpoolError, match="full"):
        spool.store(manifest_of(), PARTS)
    assert list(tmp_path.iterdir()) == []


def change(path, **fields) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))


def content(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix in (".pgm", ".json")}


def test_an_image_whose_manifest_cannot_be_read_stays_and_is_delivered_by_the_release_that_can(tmp_path):
    Spool(tmp_path).store(manifest_of("0001-board"), PARTS)
    Spool(tmp_path).store(manifest_of("0002-board"), PARTS)
    manifest_path = tmp_path / "s~0001-board~5.json"
    original = manifest_path.read_text()
    change(manifest_path, schema=7, format="a format of later")
    before = content(tmp_path)
    for _ in range(3):  # as often as the node starts
        spool = claimed(tmp_path)
        contents = spool.contents()
        assert [m.key.capture_id for m in contents.waiting] == ["0002-board"]
        assert list(contents.unread) == ["s~0001-board~5.json"]
        assert "schema 7" in contents.unread["s~0001-board~5.json"]
        spool.release()
    assert content(tmp_path) == before
    manifest_path.write_text(original)  # what the other release makes of it
    assert len(claimed(tmp_path).manifests()) == 2


def test_a_release_before_can_read_what_this_one_has_stored(tmp_path):
    """The first release sets a manifest with any other field aside, and removes its image at the next start."""
    manifest = replace(manifest_of(), settings_hash="a" * 64, metadata={"Lux": 7}, unknown={"lens": "wide"})
    Spool(tmp_path).store(manifest, PARTS)
    document = json.loads((tmp_path / "s~0001-board~5.json").read_text())
    first = "schema type node key kind sha256 bytes width height time_ns exposure_us format metadata"
    assert set(document) == set(first.split())
    assert (document["schema"], document["metadata"]["Lux"]) == (1, 7)
    assert claimed(tmp_path).manifests() == [manifest]
    delivered_by_it = json.dumps(document, separators=(",", ":")).encode()
    assert decode(delivered_by_it) == manifest, "and the controller still knows all of it"


def test_a_delivered_image_whose_manifest_cannot_be_read_is_no_fault(tmp_path):
    spool = Spool(tmp_path)
    spool.store(manifest_of(), PARTS)
    spool.deliver(manifest_of().key, manifest_of().sha256)
    change(tmp_path / "s~0001-board~5.json", format="a format of later")
    contents = claimed(tmp_path).contents()
    assert (contents.waiting, contents.delivered, contents.unread) == ((), (), {})


def test_a_manifest_with_fields_of_a_later_release_is_delivered(tmp_path):
    Spool(tmp_path).store(manifest_of(), PARTS)
    change(tmp_path / "s~0001-board~5.json", schema=2, lens="wide")
    (manifest,) = claimed(tmp_path).manifests()
    assert json.loads(encode(manifest))["lens"] == "wide"


def test_a_manifest_that_the_release_before_has_set_aside_counts_again(tmp_path):
    Spool(tmp_path).store(manifest_of(), PARTS)
    (tmp_path / "s~0001-board~5.json").rename(tmp_path / "s~0001-board~5.damaged")
    assert claimed(tmp_path).manifests() == [manifest_of()]


def test_an_image_without_a_manifest_is_kept_and_counted(tmp_path):
    (tmp_path / "s~0001-board~5.pgm").write_bytes(b"".join(PARTS))
    (tmp_path / ".partial-s~0002-board~6.pgm").write_bytes(b"".join(PARTS))  # whole, but who knows of what
    (tmp_path / ".partial-s~0003-board~7.pgm").write_bytes(b"".join(PARTS)[:-1])
    (tmp_path / ".partial-s~0003-board~7.json").write_bytes(b"{")
    for _ in range(2):
        spool = claimed(tmp_path)
        assert spool.aside == 2
        spool.release()
    assert {path.read_bytes() for path in (tmp_path / "aside").iterdir()} == {b"".join(PARTS)}
    assert sorted(path.name for path in tmp_path.iterdir()) == [".claim", "aside"], "what breaks off is removed"


def test_a_damaged_image_is_told_and_the_others_stay(tmp_path):
    Spool(tmp_path).store(manifest_of("0001-board"), PARTS)
    Spool(tmp_path).store(manifest_of("0002-board"), PARTS)
    (tmp_path / "s~0001-board~5.pgm").write_bytes(b"short")
    contents = claimed(tmp_path).contents()
    assert [m.key.capture_id for m in contents.waiting] == ["0002-board"]
    assert "5 bytes instead of 17" in contents.unread["s~0001-board~5.json"]
    assert (tmp_path / "s~0001-board~5.pgm").exists()


@pytest.mark.parametrize("name", ["x.freed", "a~b~c.freed", "x.json", "x.pgm", ".partial-", "x~y~5.freed"])
def test_a_file_of_somebody_else_does_not_keep_the_node_from_starting(tmp_path, name):
    Spool(tmp_path).store(manifest_of(), PARTS)
    (tmp_path / name).write_bytes(b"{")
    spool = claimed(tmp_path)
    assert spool.manifests() == [manifest_of()]
    assert all(isinstance(key, CaptureKey) for key in spool.tombstones())


def test_a_missing_image_is_an_error_with_its_name(tmp_path):
    with pytest.raises(SpoolError, match="s/0009-board"):
        Spool(tmp_path).read(CaptureKey("s", "0009-board", 1))
