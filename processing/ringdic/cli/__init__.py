"""The command ``ringdic``."""
