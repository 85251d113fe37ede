"""The results of a processing run: their arrays, the file that stores them, and the fields evaluated from them.

``results``        the results and the 2D matches, as arrays
``series``         some of the steps of results, and a cache of what is computed for each step
``layout``         the layout of the file, results.h5, which ``writer`` writes and ``reader`` reads
``vtkhdf``         the part of the file that ParaView opens
``fields``         the table of fields, and their values at one step
``ranges``         ranges of the fields over all steps, for colour scales
``evaluation``     results with another reference step, strain window or family of strains than the run's
``uncertainty``    completes results with the standard deviations that follow from their matches and cameras
``unmeasured``     textured places that were not measured, and why
``noise_floor``    statistics of a specimen at rest
``colours``        colours of field values
"""
