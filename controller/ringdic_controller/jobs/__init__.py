"""Processing jobs and the child processes that carry them out."""
