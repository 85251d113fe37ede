"""Deformation of a triangulated surface: stretches, strains, strain windows, and rigid motion."""
