# SPDX-License-Identifier: Apache-2.0
"""Which instrument measured, and how its values are traceable: certificate, laboratory, dates.

Nothing is computed from these facts. They are carried to results and certificates, and an
instrument that was used after its due date is a finding (ISO/IEC 17025:2017, section 6.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import date
from typing import TYPE_CHECKING

from loopcal.errors import DataError
from loopcal.findings import Finding, report_finding

if TYPE_CHECKING:
    from loopcal.measure.observations import Observations

DATES = ("calibrated", "due", "measured")
"""Fields that hold a date."""


@dataclass(frozen=True)
class InstrumentRecord:
    """An instrument and its calibration; a text that is empty is not stated.

    Parameters
    ----------
    name : what people call it. manufacturer, model, serial_number : which one it is.
    certificate : number of its calibration certificate. laboratory : that issued it.
    standard : reference standard or procedure of that calibration, such as "ISO 10360-10".
    calibrated, due : dates of its calibration and of the next one, as 2026-05-31.
    measured : date of these measurements.

    Raises
    ------
    DataError : not a date, or the due date lies before the calibration.
    """

    name: str = ""
    manufacturer: str = ""
    model: str = ""
    serial_number: str = ""
    certificate: str = ""
    laboratory: str = ""
    standard: str = ""
    calibrated: str = ""
    due: str = ""
    measured: str = ""

    def __post_init__(self) -> None:
        for key in DATES:
            _parse_date(key, getattr(self, key))
        if self.due and self.calibrated and self.due < self.calibrated:
            raise DataError(
                f"due is {self.due}, which is before calibrated, {self.calibrated}; correct one"
            )

    def __str__(self) -> str:
        """Return the instrument as a sentence names it."""
        name = self.name or " ".join(x for x in (self.manufacturer, self.model) if x)
        number = f"serial number {self.serial_number}" if self.serial_number else ""
        return ", ".join(part for part in (name, number) if part) or "without a name"

    @property
    def is_traceable(self) -> bool:
        """Whether a certificate and the date of calibration are stated."""
        return bool(self.certificate and self.calibrated)

    def to_dict(self) -> dict[str, str]:
        """Return the stated facts by name."""
        return {name: value for name, value in asdict(self).items() if value}


def list_instruments(observations: Sequence[Observations]) -> tuple[InstrumentRecord, ...]:
    """Return the stated instruments of rows, each once."""
    stated = (rows.instrument for rows in observations)
    return tuple(dict.fromkeys(record for record in stated if record is not None))


def check_instruments(observations: Sequence[Observations]) -> list[Finding]:
    """Return the instruments that were not validly calibrated when they measured.

    Dates are compared with each other, not with the clock: without the date of the measurements
    nothing can be said.
    """
    findings = []
    for record in list_instruments(observations):
        dates = {name: getattr(record, name) for name in DATES}
        if not record.measured:
            if record.due:
                findings.append(
                    report_finding(
                        "data.instrument-not-dated", instrument=str(record), due=record.due
                    )
                )
        elif record.due and record.measured > record.due:
            findings.append(
                report_finding("data.instrument-past-due", instrument=str(record), **dates)
            )
        elif record.calibrated and record.measured < record.calibrated:
            findings.append(
                report_finding("data.instrument-calibrated-later", instrument=str(record), **dates)
            )
    return findings


def _parse_date(key: str, text: str) -> None:
    """Refuse a text that is no date of the form 2026-05-31."""
    if not text:
        return
    try:
        is_date = date.fromisoformat(text).isoformat() == text
    except ValueError:
        is_date = False
    if not is_date:
        raise DataError(f"{key} is {text!r}; write a date as 2026-05-31")
