"""Measurements on results: time series at material points, extensometers, sections, regions, strain window study.

=================  ==========================================================================================
``place``          a material place on the reference surface: a triangle and where in it
``path``           the shortest path along the surface between two places, a material line at every step
``series``         fields of places through time
``extensometer``   the length between two places, along the surface and straight
``section``        fields along a cut of the surface with a plane or a half-plane through the axis
``region``         statistics over a part of the surface
``window_study``   how strain and its scatter depend on the width of the strain window
``table``          the result of all of them: columns with units, as CSV or JSON
=================  ==========================================================================================

Places, paths and regions are chosen on the reference configuration and then follow the material. What was not measured
at a step is NaN, an empty cell in CSV, null in JSON.
"""
