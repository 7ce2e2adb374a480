# SPDX-License-Identifier: Apache-2.0
"""Check refusals by the code and the data of their finding."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from loopcal.errors import EstimationError, LoopcalError


@contextmanager
def refuses(
    code: str, error: type[LoopcalError] = EstimationError, **data: Any
) -> Iterator[dict[str, Any]]:
    """Expect an error with this code and these data; yields a dictionary that receives all data."""
    received: dict[str, Any] = {}
    with pytest.raises(error) as caught:
        yield received
    assert caught.value.code == code, str(caught.value)
    received.update(caught.value.args[0].data)
    assert data.items() <= received.items(), received
