"""Processing jobs and the child processes that run them."""
