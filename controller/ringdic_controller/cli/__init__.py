"""The commands that the controller adds to ``ringdic``: demo, controller, validate, bench."""
