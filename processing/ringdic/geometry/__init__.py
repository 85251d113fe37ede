"""Cameras and points in space: projection, lens distortion, triangulation, outliers."""
