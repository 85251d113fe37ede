"""Arranges the public images of the paper's rig as a folder for ``ringdic import``.

python tests/rigs/multidic_pair/arrange.py shared/data/multidic_rig FOLDER
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

CAMERAS = ("201", "202")


def arrange(data: Path, folder: Path) -> Path:
    """Link or copy boards, target and specimen of ``multidic_rig`` into ``folder`` beside the rig.toml."""
    folder.mkdir(parents=True)
    shutil.copyfile(Path(__file__).with_name("rig.toml"), folder / "rig.toml")
    for camera in CAMERAS:
        _copy(sorted((data / "checkerboard" / camera).glob("*.jpg")), folder / "board" / camera)
        _copy(sorted((data / "speckle").glob(f"{camera}_*.jpg")), folder / "specimen" / camera)
    _copy([data / "calibration" / f"{camera}.jpg" for camera in CAMERAS], folder / "target")
    return folder


def _copy(images: list[Path], folder: Path) -> None:
    folder.mkdir(parents=True)
    for image in images:
        shutil.copyfile(image, folder / image.name)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    print(arrange(Path(sys.argv[1]), Path(sys.argv[2])))
