"""Pairwise surfaces made one, after Solav et al. 2018: overlaps removed, gaps stitched, small holes closed."""

from ringdic.pairs.merging.merge import HEURISTICS, Merged, Seam, SurfacePart, merge
from ringdic.pairs.merging.mismatch import Mismatch, mismatches

__all__ = ["HEURISTICS", "Merged", "Mismatch", "Seam", "SurfacePart", "merge", "mismatches"]
