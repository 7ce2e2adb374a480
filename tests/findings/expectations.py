# SPDX-License-Identifier: Apache-2.0
"""Expectations about findings: which codes occur, and which code refuses an input."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from loopcal.errors import EstimationError, LoopcalError
from loopcal.findings import Finding


def list_codes(findings: Iterable[Finding]) -> set[str]:
    """Return the codes of findings."""
    return {finding.code for finding in findings}


def get_finding(findings: Iterable[Finding], code: str) -> Finding:
    """Return the only finding with this code."""
    (finding,) = (finding for finding in findings if finding.code == code)
    return finding


@contextmanager
def expect_refusal(
    code: str, error: type[LoopcalError] = EstimationError, **data: object
) -> Iterator[dict[str, Any]]:
    """Expect an error made from the finding with this code and, among others, these data.

    Yields a dictionary that receives all data.
    """
    received: dict[str, Any] = {}
    with pytest.raises(error) as caught:
        yield received
    assert caught.value.code == code, str(caught.value)
    received.update(caught.value.args[0].data)
    assert {name: received[name] for name in data} == data
