"""``python -m ringdic_node.virtual_rig FOLDER``: render a measurement of the simulated rig into a folder of images.

``ringdic import FOLDER SESSION`` makes a session of it. Exit codes: 0 done, 2 bad input, 3 the extra is missing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``python -m ringdic_node.virtual_rig`` with its command-line arguments; return the exit code."""
    options = _parser().parse_args(arguments)
    try:
        from ringdic_node.virtual_rig.folder import Measurement, write_folder
        from ringdic_node.virtual_rig.rig import VirtualRig, paper_rig
    except ImportError as error:
        return _fail(f"the renderer cannot be loaded ({error}); install the extra: pip install 'ringdic[virtual]'", 3)
    try:
        ring = paper_rig(options.ring, options.scale, options.seed).cameras
        if not 2 <= options.cameras <= len(ring):
            raise ValueError(f"--cameras must lie between 2 and the {len(ring)} of the ring, not {options.cameras}")
        for name, least in (("boards", 3), ("steps", 0), ("at_rest", 0)):
            if getattr(options, name) < least:
                raise ValueError(f"--{name.replace('_', '-')} must be at least {least}, not {getattr(options, name)}")
        measurement = Measurement(options.boards, options.steps, options.at_rest, options.specimen, options.seed)
        write_folder(options.folder, VirtualRig(ring[: options.cameras]), measurement, _tell)
    except FileExistsError:
        return _fail(f"{options.folder} exists already; choose another folder", 2)
    except (ValueError, OSError) as error:
        return _fail(str(error), 2)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m ringdic_node.virtual_rig",
        description="Render checkerboard, calibration target and specimen as the cameras of a simulated ring see them.",
    )
    parser.add_argument("folder", type=Path, help="the folder to make")
    parser.add_argument("--cameras", type=int, default=3, help="neighbouring cameras that take images (default 3)")
    parser.add_argument("--ring", type=int, default=12, help="places on the ring, evenly spread (default 12)")
    parser.add_argument("--scale", type=float, default=0.2, help="image size; 1 is 2464 x 3280 px (default 0.2)")
    parser.add_argument("--boards", type=int, default=8, help="views of the checkerboard (default 8)")
    parser.add_argument("--steps", type=int, default=2, help="deformed steps after the reference (default 2)")
    parser.add_argument("--at-rest", type=int, default=0, help="further images of the undeformed specimen (default 0)")
    parser.add_argument("--specimen", choices=("limb", "cylinder"), default="limb", help="default limb")
    parser.add_argument("--seed", type=int, default=0, help="of the cameras' scatter, the speckles and the noise")
    return parser


def _tell(done: int, total: int) -> None:
    if done % 10 == 0 or done == total:
        sys.stderr.write(f"{done} of {total} images rendered\n")


def _fail(sentence: str, code: int) -> int:
    sys.stderr.write(f"{sentence}\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
