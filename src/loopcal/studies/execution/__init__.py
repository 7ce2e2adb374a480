# SPDX-License-Identifier: Apache-2.0
"""Workers of studies: this process, processes of this computer, a dask or a ray cluster."""
