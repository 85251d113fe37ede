"""What is done with a session: the whole processing, one step at once, a warm process, more than one machine."""
