"""Pictures of fields: on the unrolled surface, on the body from a side, over the photographs, animated over the steps.

``painter`` rasterises the triangles into an image of triangle numbers; colours are looked up by these numbers, so that
a view rasterised once serves every field. ``scale`` holds a field's colours, limits and colour bar, ``views`` the
projections of the surface, ``overlay`` draws a field over a photograph, ``animation`` writes GIF and MP4. What was not
measured stays blank; ``unmeasured`` draws it on the photographs of the reference, by reason.
"""
