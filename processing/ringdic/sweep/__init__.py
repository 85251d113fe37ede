"""Depth sweep between two calibrated cameras, for the region that both see and the start values of its matches."""
