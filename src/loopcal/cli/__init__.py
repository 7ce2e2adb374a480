# SPDX-License-Identifier: Apache-2.0
"""The command line: parse, call one library function, print.

`main` is the one place where an error becomes a sentence and an exit code: 0 good, 1 user error, 2
a quality gate not met. Nothing heavier than click is imported before a command runs, so that
`loopcal --help` answers at once.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence

import click

from loopcal.cli.calibrate import calibrate
from loopcal.cli.check import check
from loopcal.cli.compensate import compensate
from loopcal.cli.export import export
from loopcal.cli.hints import HINTS
from loopcal.cli.identifiability import identifiability
from loopcal.cli.import_ import import_
from loopcal.cli.new import new
from loopcal.cli.plan import plan
from loopcal.cli.reproduce import reproduce
from loopcal.cli.simulate import simulate
from loopcal.cli.validate import validate
from loopcal.errors import LoopcalError


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="loopcal", message="loopcal %(version)s")
def commands() -> None:
    """Calibrate the geometry of robots with closed kinematic loops.

    \b
    Example, from nothing to a calibrated hexapod:
      loopcal check hexapod-42
      loopcal calibrate hexapod-42 measurements.csv -o run --hold-out 0.25
      loopcal validate run more-measurements.csv
    """  # noqa: D301


for _command in (
    new,
    check,
    plan,
    simulate,
    identifiability,
    calibrate,
    validate,
    compensate,
    reproduce,
    import_,
    export,
):
    commands.add_command(_command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after `loopcal`; default those of the process.
    """
    # many small factorisations: threads of the linear algebra wait for each other more than they
    # help (5000 poses on two cores: 0.3 s with one, 5 s and more with two); whoever sets these
    # variables decides
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    notes, logger = _Notes(), logging.getLogger("loopcal")
    logger.addHandler(notes)
    try:
        code = commands.main(arguments, prog_name="loopcal", standalone_mode=False)
        sys.stdout.flush()
        return code if isinstance(code, int) else 0
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return 1
    except click.ClickException as error:
        return _refuse(error.format_message())
    except LoopcalError as error:
        hint = HINTS.get(error.code or "")
        return _refuse(f"{error} ({hint})" if hint else str(error))
    except (KeyboardInterrupt, click.exceptions.Abort):
        return _refuse("stopped before the end; no result was written.")
    except BrokenPipeError:
        # The reader of our output went away (`loopcal ... | head`); keep the interpreter from
        # complaining at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        return _refuse(
            f"{place}the operating system refused ({(error.strerror or str(error)).lower()}); "
            "check the place."
        )
    except MemoryError:
        return _refuse("there is not enough memory for this; use fewer poses at a time.")
    finally:
        logger.removeHandler(notes)


class _Notes(logging.Handler):
    """What the library has to say beside its results, as a line on standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        click.echo(f"loopcal: note: {record.getMessage()}", err=True)


def _refuse(sentence: str) -> int:
    """Print one sentence on standard error and return the exit code of a user error."""
    click.echo(f"loopcal: {' '.join(sentence.split())}", err=True)
    return 1
