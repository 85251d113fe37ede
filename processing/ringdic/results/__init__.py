"""What a run of the processing found, the file that keeps it, and what can be evaluated from it."""
