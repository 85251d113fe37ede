"""Measurement of a surface of any shape by all cameras, each on the part of it that it faces most squarely.

At the reference:
``plane_sweep`` searches start values with slanted planes, ``depth_map`` grows from them the depth over each camera's
image, by ``patches`` of surface as one camera sees them. ``views`` tells which camera faces a part most squarely, and
which others see it: its chart. ``matching`` matches the chart's grid in the reference ``images`` of all of them,
``chart`` adds the uncertainty, and ``surface`` triangulates the charts by ``agreement`` of their views, with smooth
``weights``, and merges them.
``unmeasured`` finds the texture that the surface does not cover, and ``evidence`` why a camera does not match.

In time:
``tracked_points`` and ``step_matching`` match points of one image in a later one of the same camera, with warps that
``body_motion`` predicts where the body has turned far. ``tracking`` lays them on a grid over all that the camera sees,
and ``series`` triangulates every step. ``tasks`` divides the work.
"""
