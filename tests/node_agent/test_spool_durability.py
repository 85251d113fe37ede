"""The spool: what is committed survives, what is not does not count, and only the right hash frees."""

from __future__ import annotations

import os

import pytest
from ringdic_node.spool import Spool, SpoolError, image_digest
from ringdic_node.wire import CaptureKey, Manifest

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


def test_only_its_own_hash_frees_an_image_and_a_tombstone_stays(tmp_path):
    spool, manifest = Spool(tmp_path), manifest_of()
    spool.store(manifest, PARTS)
    assert spool.remove(manifest.key, "0" * 64) is False
    assert spool.manifests() == [manifest]
    assert spool.remove(manifest.key, manifest.sha256) is True
    assert spool.remove(manifest.key, manifest.sha256) is False
    again = Spool(tmp_path)
    assert again.manifests() == []
    assert again.tombstones() == [manifest.key]
    with pytest.raises(SpoolError, match="already"):
        again.store(manifest, PARTS)


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


def test_a_damaged_image_is_set_aside_and_the_others_stay(tmp_path):
    spool = Spool(tmp_path)
    spool.store(manifest_of("0001-board"), PARTS)
    spool.store(manifest_of("0002-board"), PARTS)
    (tmp_path / "s~0001-board~5.pgm").write_bytes(b"short")
    assert [m.key.capture_id for m in Spool(tmp_path).manifests()] == ["0002-board"]
    assert (tmp_path / "s~0001-board~5.damaged").exists()


def test_a_missing_image_is_an_error_with_its_name(tmp_path):
    with pytest.raises(SpoolError, match="s/0009-board"):
        Spool(tmp_path).read(CaptureKey("s", "0009-board", 1))
