"""Executors: where what does not depend on one another is computed, such as the members of an ensemble.

`InProcess`, one after the other, is the default. `Distributed` has the workers of a scheduler of Dask's distributed, on
any number of machines; `local_workers` starts some on this one, such as one for each GPU.
"""

from cortado.calls import face
from cortado.device.executors.distributed import Distributed
from cortado.device.executors.executor import Executor, InProcess
from cortado.device.executors.local import local_workers

__all__ = ["Distributed", "Executor", "InProcess", "local_workers"]

__dir__ = face(globals())
