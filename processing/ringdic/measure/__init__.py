"""What is asked of results beyond maps: places followed through time, lengths between them, sections, regions.

=================  ==========================================================================================
``place``          a material place on the reference surface: a triangle and where in it
``path``           the shortest way along the surface between two places, of the same material at every step
``series``         fields of places through time
``extensometer``   the length between two places, along the surface and straight
``section``        fields along a cut of the surface with a plane or a half-plane through the axis
``region``         statistics over a part of the surface
``window_study``   how strain and its scatter change with the window it is fitted over
``table``          what all of them return: columns with units, as CSV or JSON
=================  ==========================================================================================

Everything is material: chosen on the reference configuration, then followed. What was not measured at a step is NaN
there, an empty cell in CSV, null in JSON.
"""
