# SPDX-License-Identifier: Apache-2.0
"""`loopcal measure` and `loopcal app`: a companion on the terminal, and a page in the browser."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

import loopcal as lc
from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.hints import suggest_command
from loopcal.cli.terminal import Output
from loopcal.errors import DataError
from loopcal.units import Dimension, list_symbols

if TYPE_CHECKING:
    from loopcal.io.data.kind_settings import KindRows
    from loopcal.io.exports.growing_export import GrowingExport


def make_export(given: Mapping[str, Any]) -> Callable[[KindRows], GrowingExport] | None:
    """Return what gives the export to follow, for the kind of a sheet; None without one."""
    from loopcal.io.exports.growing_export import GrowingExport
    from loopcal.io.exports.profile import find_profile_file, read_profile, with_local_settings

    path, profile = given["follow"], given["profile"]
    if (path is None) != (profile is None):
        raise DataError("--follow and --profile belong together. Give both, or none")
    if path is None:
        opt.refuse_given(("unit", "decimal", "by_order"), "without --follow")
        return None
    read = read_profile(find_profile_file(profile))
    read = with_local_settings(read, given["unit"], given["decimal"] == "comma")
    return lambda entry: GrowingExport(path.absolute(), read, entry, given["by_order"])


FOLLOWED: Any = opt.Group(
    make_export,
    follow=opt.path("Also take rows from the export that an instrument writes.", metavar="EXPORT"),
    profile=opt.profile("How to read --follow."),
    unit=opt.option(
        "Unit of lengths in --follow.  [default: from the profile]",
        type=click.Choice(list_symbols(Dimension.LENGTH)),
    ),
    decimal=opt.DECIMAL,
    by_order=opt.flag("Ignore names in --follow: rows belong to the suggested poses."),
)


@opt.command()
def measure(
    plan: Path = opt.argument("PLAN", type=opt.FILE),
    output: Path = opt.path("Folder of the session, new or to resume.", "-o", required=True),
    robot: str | None = opt.option(
        "Robot file, or the name of a shipped robot.  [default: from PLAN]"
    ),
    accuracy: tuple[float, Literal["position", "orientation"]] | None = opt.option(
        "Goal: error over the workspace (rms), such as 20um or 10urad.  [default: from PLAN]",
        type=opt.GOAL,
    ),
    minutes: float | None = opt.option(
        "Time to measure a pose. loopcal then shows the time left.",
        type=opt.POSITIVE,
        metavar="MINUTES",
    ),
    speed: float | None = opt.option(
        "Speed of travel in mm per minute, with --minutes.  [default: travel takes no time]",
        type=opt.POSITIVE,
        metavar="NUMBER",
    ),
    check_every: int = opt.option(
        "Number of rows between two checks for drift, which measure a pose again. 0: no checks.",
        of="loopcal.planning.companion:CompanionTask",
        type=opt.Count("PLANNED_POSES", 0),
    ),
    followed: Callable[[KindRows], GrowingExport] | None = FOLLOWED,
    gcode: bool = opt.flag("Show each pose as a line of G-code, too."),
    at: tuple[tuple[str, float], ...] = opt.AT,
) -> Output:
    """Measure the poses of PLAN, a folder or its measurements.csv, with a companion.

    It shows the next pose and takes the measured values: typed or pasted, from standard input, or
    from the export of an instrument. After each row it says whether the row fits, how accurate the
    robot is by now, and when to stop. It writes each row to the disk before it asks for the next
    one. To resume a session, repeat the command.

    Examples:
      loopcal measure plan -o session --accuracy 20um
      loopcal measure plan -o session --minutes 2 --gcode
      loopcal measure plan -o session --follow points.txt --profile leica
    """
    from loopcal.cli.measuring_dialog import Dialog, print_lines
    from loopcal.findings.wording import name_count
    from loopcal.io.runs.plan_folder import DATA, find_plan_robot
    from loopcal.io.runs.session_folder import open_session
    from loopcal.measuring import make_pace, prepare_session

    pace = make_pace(minutes, speed)
    sheet = plan / DATA if plan.is_dir() else plan
    if robot is None:
        robot, has_changed = find_plan_robot(sheet)
        if has_changed:
            terminal.print_finding("session.robot-changed", robot=robot)
    machine = lc.load_robot(robot).with_conditions(dict(at))
    task, table, entry = prepare_session(sheet, machine, accuracy, pace, check_every)
    export = followed(entry) if followed else None
    is_silent = click.get_current_context().params["as_json"]
    say = (lambda *_: None) if is_silent else print_lines
    with open_session(output, table, [column.name for column in entry.kind.columns]) as journal:
        dialog = Dialog(task, journal, say, export, gcode)
        with suppress(KeyboardInterrupt):  # each row is on the disk
            dialog.run()
    visits = journal.visits
    used = sum(bool(visit.is_used) for visit in visits)
    data = output / DATA
    document = {
        "session": output,
        "measurements": data if used else None,
        "rows": len(visits),
        "used": used,
        "findings": dialog.progress,
    }
    page = [f"{output}: {name_count(len(visits), 'row')}, {used} used"]
    if used:
        page.append(suggest_command("calibrate", robot, data, "-o", "run"))
    return Output(document, lambda: page)


@opt.command()
def app(
    host: str = opt.option(
        "Address to listen on, such as 0.0.0.0 for a tablet.", default="127.0.0.1"
    ),
    port: int = opt.option(
        "Port.  [default: a free one]", default=0, type=opt.Count(least=0, most=65535)
    ),
    keep: Path | None = opt.path(
        "Folder that keeps the files, new or to go on with.", metavar="DIR"
    ),
    no_browser: bool = opt.flag("Do not open the page in the browser."),
    followed: Callable[[KindRows], GrowingExport] | None = FOLLOWED,
) -> Output:
    """Calibrate and measure on a page in the browser, until Ctrl-C.

    Drop printer.cfg, config.g with a console log, or a robot file with measurements, and see the
    result. Correct or leave out a row and calibrate again. Download the corrected file and the
    report, or measure the poses of a plan with the companion.

    The page is for this computer only, unless --host names another address. loopcal removes its
    files at the end unless --keep names a folder. The command needs the extra 'app'.

    Examples:
      loopcal app
      loopcal app --keep delta
      loopcal app --host 192.168.1.20 --keep hexapod
      loopcal app --follow points.txt --profile leica
    """
    import asyncio
    from tempfile import gettempdir

    from loopcal.documents import open_page
    from loopcal.environment import import_optional
    from loopcal.io.core.text_file import create_temporary, remove_leftovers, report_write_errors

    import_optional("tornado.web", "app")
    from loopcal.app.server import serve

    def announce(address: str, once: str) -> None:
        if host not in ("127.0.0.1", "::1", "localhost"):
            terminal.print_finding("app.open-network")
        terminal.print_message(f"loopcal: open {address} (Ctrl-C ends it)")
        if not no_browser:
            open_page(once)

    private = Path(gettempdir(), "loopcal-app")
    remove_leftovers(private, Path.is_dir)  # of a server that was killed
    with ExitStack() as stack:
        with report_write_errors(keep or private):
            if keep is None:
                folder = stack.enter_context(create_temporary(private, is_folder=True))
                folder.chmod(0o700)
            else:
                folder = keep
                folder.mkdir(parents=True, exist_ok=True)
        asyncio.run(serve(folder, host, port, announce, followed))
    return Output({"kept": keep}, lambda: [f"Kept in {keep}"] if keep else [])
