"""The session folders on disk, and their catalogue."""
