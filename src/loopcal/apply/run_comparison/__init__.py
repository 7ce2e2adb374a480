# SPDX-License-Identifier: Apache-2.0
"""Several calibrations side by side: sessions, robots or methods."""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.apply.run_comparison.comparison import RunComparison as RunComparison
    from loopcal.apply.run_comparison.comparison import RunSummary as RunSummary
    from loopcal.apply.run_comparison.comparison import compare_runs as compare_runs
    from loopcal.apply.run_comparison.held_out_errors import QuantityErrors as QuantityErrors
    from loopcal.apply.run_comparison.pair_comparison import PairComparison as PairComparison
    from loopcal.apply.run_comparison.stored_run import StoredRun as StoredRun
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.apply.run_comparison.comparison": "RunComparison RunSummary compare_runs",
            "loopcal.apply.run_comparison.held_out_errors": "QuantityErrors",
            "loopcal.apply.run_comparison.pair_comparison": "PairComparison",
            "loopcal.apply.run_comparison.stored_run": "StoredRun",
        },
    )
