"""Depth sweep between two calibrated cameras: the region that both see, and start values of its matches."""
