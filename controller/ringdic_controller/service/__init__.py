"""The HTTP service: the page, the resources under it and their live state."""
