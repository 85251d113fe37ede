"""Merging of surfaces into one (after Solav et al. 2018): overlaps removed, gaps stitched, small holes filled."""

from ringdic.merging.merge import HEURISTICS, MergedSurface, SurfacePart, merge, side_by_side
from ringdic.merging.mismatch import Mismatch, mismatches

__all__ = ["HEURISTICS", "MergedSurface", "Mismatch", "SurfacePart", "merge", "mismatches", "side_by_side"]
