"""Benchmarks of more than one package: what the rig and a whole job take on this machine."""
