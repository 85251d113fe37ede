"""Measurement of a surface by all cameras, each on its own part of it."""
