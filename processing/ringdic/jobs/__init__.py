"""Jobs on a session: processing all of it or a single step, in this process, in a waiting one or on a cluster.

``pipeline``    from the session folder to the results
``summary``     the figures of a run
``run``         a finished run as an object: fields, drawings, measurements, exports
``live_step``   processing of a single step during the capture
``serving``     a waiting process with loaded kernels, which carries out orders
``compiling``   compiles all kernels once, by several processes side by side
``warm_up``     compiles the kernels that follow the matching
``allocation``  how the process asks the system for memory
``cluster``     tasks on more than one machine
"""
