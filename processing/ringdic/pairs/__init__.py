"""Measurement by camera pairs: matching between cameras and in time, triangulation, and merging of the surfaces."""
