"""The scenes of the virtual rig, each with its exact truth: checkerboard, calibration target, specimens."""

from __future__ import annotations

from ringdic_node.virtual_rig.scenes.board import BoardScene
from ringdic_node.virtual_rig.scenes.damage import Bar, Damage, Hair, Shadow, SpoiltPatch
from ringdic_node.virtual_rig.scenes.solid import Solid, SolidMotion, SolidSpecimen
from ringdic_node.virtual_rig.scenes.specimen import Cylinder, Limb, Specimen
from ringdic_node.virtual_rig.scenes.target import TargetScene

Scene = BoardScene | TargetScene | Specimen | SolidSpecimen

__all__ = [
    "Bar",
    "BoardScene",
    "Cylinder",
    "Damage",
    "Hair",
    "Limb",
    "Scene",
    "Shadow",
    "Solid",
    "SolidMotion",
    "SolidSpecimen",
    "Specimen",
    "SpoiltPatch",
    "TargetScene",
    "scene",
]

_SPECIMENS = {"limb": Limb, "cylinder": Cylinder}


def scene(kind: str, index: int, specimen: str = "limb", seed: int = 0) -> Scene:
    """The scene that a simulated camera renders for a capture. index : view of the board, or step of the specimen.

    kind : board, target, specimen, or static (the specimen at rest). specimen : limb or cylinder.
    Raises ValueError for a kind, an index or a specimen that does not exist.
    """
    if index < 0:
        raise ValueError(f"the scenes of a kind are counted from 0, not {index}")
    if kind == "board":
        return BoardScene(index, seed)
    if kind == "target":
        return TargetScene()
    if kind not in ("specimen", "static"):
        raise ValueError(f"there is no scene of kind '{kind}'; use board, target, specimen or static")
    if specimen not in _SPECIMENS:
        raise ValueError(f"there is no specimen '{specimen}'; use {' or '.join(_SPECIMENS)}")
    return Specimen(_SPECIMENS[specimen](), index if kind == "specimen" else 0, seed)
