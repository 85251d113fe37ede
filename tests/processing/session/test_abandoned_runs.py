"""Folders of runs that were killed do not stay for ever, and those of runs at work stay."""

import os
from pathlib import Path

from ringdic.session.folder import new_live, new_run


def test_what_a_killed_run_left_is_removed_after_a_day_and_a_run_at_work_is_left_alone(tmp_path: Path) -> None:
    for folder, kept in (("results", ".0002.partial"), ("live", ".0004-specimen-b")):
        old = tmp_path / folder / ".0001.partial"
        for partial in (old, tmp_path / folder / kept):
            partial.mkdir(parents=True)
            (partial / "results.h5").touch()
        for path in (old / "results.h5", old):
            os.utime(path, (1e9, 1e9))
    with new_run(tmp_path) as run:
        (run.folder / "results.h5").touch()
    with new_live(tmp_path, "0005-specimen") as folder:
        (folder / "results.h5").touch()
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == [".0002.partial", "0001"]
    assert sorted(path.name for path in (tmp_path / "live").iterdir()) == [".0004-specimen-b", "0005-specimen"]
