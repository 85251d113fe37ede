"""Surfaces of camera pairs: matched between the cameras and in time, triangulated, and merged into one surface."""
