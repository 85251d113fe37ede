"""Merging of camera pairs' surfaces (after Solav et al. 2018): overlaps removed, gaps stitched, small holes filled."""

from ringdic.pairs.merging.merge import HEURISTICS, MergedSurface, Seam, SurfacePart, merge
from ringdic.pairs.merging.mismatch import Mismatch, mismatches

__all__ = ["HEURISTICS", "MergedSurface", "Mismatch", "Seam", "SurfacePart", "merge", "mismatches"]
