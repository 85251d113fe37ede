"""Fields drawn: on the unrolled surface, on the body seen from a side, on the photographs, and moving over the steps.

``painter`` fills triangles into an image of their numbers; everything else looks colours up by these numbers, so that
a view painted once serves every field. ``scale`` is a field's colours with their limits and bar, ``views`` are the ways
to look, ``overlay`` puts a field onto a photograph, ``animation`` writes GIF and MP4. What was not measured is blank.
"""
