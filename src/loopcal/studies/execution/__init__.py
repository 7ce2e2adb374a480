# SPDX-License-Identifier: Apache-2.0
"""Workers of studies: this process, processes of this computer, a dask or a ray cluster."""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.studies.execution.dask_cluster import Dask as Dask
    from loopcal.studies.execution.interface import Answer as Answer
    from loopcal.studies.execution.interface import Executor as Executor
    from loopcal.studies.execution.processes import Processes as Processes
    from loopcal.studies.execution.ray_cluster import Ray as Ray
    from loopcal.studies.execution.serial import Serial as Serial
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.studies.execution.dask_cluster": "Dask",
            "loopcal.studies.execution.interface": "Answer Executor",
            "loopcal.studies.execution.processes": "Processes",
            "loopcal.studies.execution.ray_cluster": "Ray",
            "loopcal.studies.execution.serial": "Serial",
        },
    )
