# SPDX-License-Identifier: Apache-2.0
"""Check conventions: units, orders, signs, columns and setup parameters of measurements."""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.diagnose.conventions.convention_check import check_conventions as check_conventions
    from loopcal.diagnose.conventions.convention_check import (
        compare_conventions as compare_conventions,
    )
    from loopcal.diagnose.conventions.convention_result import IMPLAUSIBLE as IMPLAUSIBLE
    from loopcal.diagnose.conventions.convention_result import ConventionCheck as ConventionCheck
    from loopcal.diagnose.conventions.interpretations.interpretation import (
        Interpretation as Interpretation,
    )
    from loopcal.diagnose.conventions.interpretations.reading_interpretations import (
        list_reading_interpretations as list_reading_interpretations,
    )
    from loopcal.diagnose.conventions.interpretations.value_interpretations import (
        list_interpretations as list_interpretations,
    )
    from loopcal.diagnose.conventions.setup_parameters import MovedSetups as MovedSetups
    from loopcal.diagnose.conventions.setup_parameters import find_moved_setups as find_moved_setups
    from loopcal.diagnose.conventions.stroke_explanation import (
        explain_outside_strokes as explain_outside_strokes,
    )
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.diagnose.conventions.convention_check": """
                check_conventions compare_conventions
            """,
            "loopcal.diagnose.conventions.convention_result": "IMPLAUSIBLE ConventionCheck",
            "loopcal.diagnose.conventions.interpretations.interpretation": "Interpretation",
            "loopcal.diagnose.conventions.interpretations.reading_interpretations": """
                list_reading_interpretations
            """,
            "loopcal.diagnose.conventions.interpretations.value_interpretations": """
                list_interpretations
            """,
            "loopcal.diagnose.conventions.setup_parameters": "MovedSetups find_moved_setups",
            "loopcal.diagnose.conventions.stroke_explanation": "explain_outside_strokes",
        },
    )
