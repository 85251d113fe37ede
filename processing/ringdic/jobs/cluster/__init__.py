"""The tasks of a job on a cluster of machines, by dask.distributed: the very tasks that the local executor runs.

Every machine sees the session's folder under the same path: a task reads and writes files there, and only its
description and how it ended go over the network. So a worker that dies costs the tasks it was at, which run elsewhere,
and a job that dies costs no more: started again, it makes what is missing.

``executor``  the driver's side: gives tasks to the scheduler and takes how they ended
``worker``    what runs on a worker

dask is imported when a cluster is asked for, and not before.
"""

from ringdic.jobs.cluster.executor import ClusterExecutor

__all__ = ["ClusterExecutor"]
