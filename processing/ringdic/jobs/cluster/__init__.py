"""Execution of a job's tasks on a cluster of machines, with dask.distributed.

Every machine sees the session's folder under the same path. Tasks read and write files there; only their descriptions
and outcomes go over the network. The tasks of a worker that dies run on another worker, and a job that dies computes
only the missing outputs when it is started again.

``executor``  the driver's side: submits tasks to the scheduler and collects their outcomes
``worker``    the worker's side: checks the worker and runs a task

dask is imported only when a cluster is used.
"""

from ringdic.jobs.cluster.executor import ClusterExecutor

__all__ = ["ClusterExecutor"]
