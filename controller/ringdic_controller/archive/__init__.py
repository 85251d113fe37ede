"""The catalogue of the sessions on disk."""
