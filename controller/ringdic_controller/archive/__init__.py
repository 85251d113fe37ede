"""The catalogue of the sessions on the disk."""
