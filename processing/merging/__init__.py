"""Pairwise surfaces made one, after Solav et al. 2018: overlaps removed, gaps stitched, small holes closed."""

from processing.merging.merge import HEURISTICS, Merged, Seam, Sheet, merge
from processing.merging.mismatch import Mismatch, mismatches

__all__ = ["HEURISTICS", "Merged", "Mismatch", "Seam", "Sheet", "merge", "mismatches"]
