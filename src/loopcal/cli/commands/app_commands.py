# SPDX-License-Identifier: Apache-2.0
"""`loopcal app`: calibrate and measure on a page in the browser."""

from __future__ import annotations

from pathlib import Path

import click

from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.terminal import Output


@opt.command()
def app(
    host: str = opt.option(
        "Address to listen on, such as 0.0.0.0 for a tablet.", default="127.0.0.1"
    ),
    port: int = opt.option(
        "Port.  [default: a free one]", default=0, type=click.IntRange(0, 65535)
    ),
    keep: Path | None = opt.path(
        "Folder that keeps the files, new or to go on with.", metavar="DIR"
    ),
    no_browser: bool = opt.flag("Do not open the page in the browser."),
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
    """
    import asyncio
    from tempfile import TemporaryDirectory

    from loopcal.documents import open_page
    from loopcal.environment import import_optional
    from loopcal.io.core.text_file import report_write_errors

    import_optional("tornado.web", "app")
    from loopcal.app.server import serve

    def announce(address: str, once: str) -> None:
        if host not in ("127.0.0.1", "::1", "localhost"):
            terminal.print_finding("app.open-network")
        terminal.print_message(f"loopcal: open {address} (Ctrl-C ends it)")
        if not no_browser:
            open_page(once)

    with TemporaryDirectory(prefix="loopcal-app-", ignore_cleanup_errors=True) as temporary:
        folder = keep or Path(temporary)
        with report_write_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        asyncio.run(serve(folder, host, port, announce))
    return Output({"kept": keep}, lambda: [f"Kept in {keep}"] if keep else [])
