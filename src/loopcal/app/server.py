# SPDX-License-Identifier: Apache-2.0
"""The server of `loopcal app`: who may ask, and for what.

Every request needs the token of this start, from the address that the command prints or from the
cookie that this address sets. Its Host is an address or the name given to --host, so that no name
of another site leads here, and its Origin, if it has one, is this page. No path of a client becomes
that of a file: names are cleaned, and downloads are looked up in a list.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import re
import secrets
import signal
from collections.abc import Callable
from contextlib import suppress
from ipaddress import ip_address
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import psutil
from tornado.escape import url_escape
from tornado.httpserver import HTTPServer
from tornado.httputil import split_host_and_port
from tornado.iostream import StreamClosedError
from tornado.netutil import bind_sockets
from tornado.web import Application, HTTPError, RequestHandler, stream_request_body

from loopcal.app.project import Project, check_facts
from loopcal.errors import DataError, LoopcalError
from loopcal.io.core.limits import UPLOAD_SIZE
from loopcal.io.data.kind_settings import KindRows
from loopcal.io.exports.growing_export import POLL, GrowingExport

TICK, HEARTBEAT = 0.1, 30  # seconds between looks; looks after which a page is told all again
ROWS = (15, 2000)  # of a table that a page gets at first, and at most
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src "
    "'self' data:; connect-src 'self'; frame-src 'self'; form-action 'none'; base-uri 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
# Of a report in a frame of the page: its own policy allows its own script, and it reaches nothing.
FRAMED = "sandbox allow-scripts; frame-ancestors 'self'"
ASSETS = {  # address -> file and its type; the style of the report comes first in that of the page
    "": ("app.html", "text/html"),
    "app.css": ("app.css", "text/css"),
    "app.js": ("app.js", "text/javascript"),
    "report.css": ("../report/document/report.css", "text/css"),
}
ACTIONS = (
    "change", "calibrate", "print_report", "plan", "correct", "leave_out", "measure", "tell",
    "finish", "discard",
)  # fmt: skip
STATUS = {"app.denied": 403, "app.foreign": 403, "app.gone": 404}


@stream_request_body
class Handler(RequestHandler):
    """All requests of the page of one project."""

    def initialize(self) -> None:
        """Begin with an empty body."""
        self.project: Project = self.settings["project"]
        self.body: bytearray = bytearray()

    def set_default_headers(self) -> None:
        """Forbid what the page does not need."""
        for name, value in HEADERS.items():
            self.set_header(name, value)

    def prepare(self) -> None:
        """Refuse other hosts and origins, requests without the token, and large ones."""
        host = split_host_and_port(self.request.host.lower())[0].strip("[]")
        cookie, token = self.settings["cookie"], self.settings["token"]
        own, is_known = f"http://{self.request.host}", host in ("localhost", self.settings["host"])
        with suppress(ValueError):
            is_known = is_known or bool(ip_address(host))
        if not is_known or self.request.headers.get("Origin", own) != own:
            raise DataError.of("app.foreign")
        given = self.get_query_argument("token", self.get_cookie(cookie, "") or "")
        if given in (once := self.settings["once"]):
            once.clear()
        elif not hmac.compare_digest(given.encode(), token.encode()):
            raise DataError.of("app.denied")
        self.set_cookie(cookie, token, httponly=True, samesite="Strict")
        UPLOAD_SIZE.check(int(self.request.headers.get("Content-Length", 0)), "file", "page")

    def data_received(self, chunk: bytes) -> None:
        """Take a part of the body."""
        self.body += chunk
        UPLOAD_SIZE.check(len(self.body), "file", "page")

    def write_error(self, status_code: int, **facts: Any) -> None:
        """Answer with the sentence of an error."""
        text, error = self._reason, facts.get("exc_info", (None, None))[1]
        if isinstance(error, LoopcalError):
            text = self.project.word(error)
            self.set_status(STATUS.get(error.code or "", 400))
        if self.request.path == "/":  # people read it
            self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(text if self.request.path == "/" else {"error": text})

    def log_exception(self, typ: Any, value: Any, tb: Any) -> None:
        """Log defects alone."""
        if not isinstance(value, LoopcalError | HTTPError):
            super().log_exception(typ, value, tb)

    async def get(self, name: str) -> None:
        """Send the page, what it shows whenever that changes, rows, or a file of the project."""
        if name == "events":
            await self._send_events()
        elif name == "rows":
            most = ROWS[self.get_query_argument("all", "") == "1"]
            is_sorted = self.get_query_argument("sorted", "1") == "1"
            self.finish(await asyncio.to_thread(self.project.list_rows, most, is_sorted))
        elif name in ASSETS:
            file, kind = ASSETS[name]
            self.set_header("Content-Type", f"{kind}; charset=utf-8")
            self.finish(Path(__file__).parent.joinpath(file).read_bytes())
        elif name in self.project.list_downloads() and self.project.has(name):
            self._send_file(self.project.folder / name)
        else:
            raise DataError.of("app.gone")

    async def _send_events(self) -> None:
        self.set_header("Content-Type", "text/event-stream")
        sent = -1
        with suppress(StreamClosedError):
            for tick in takewhile(lambda _: not self.settings["ended"].is_set(), count()):
                is_due = self.project.version != sent or tick % HEARTBEAT == 0
                if is_due and not self.settings["lock"].locked():  # not amid an action
                    sent, shown = self.project.version, self.project.describe()
                    self.write(f"data: {json.dumps(shown)}\n\n")
                    await self.flush()
                await asyncio.sleep(TICK)

    def _send_file(self, file: Path) -> None:
        is_shown = file.suffix == ".html" and self.get_query_argument("show", "") != ""
        if is_shown:
            self.set_header("Content-Security-Policy", FRAMED)
            self.set_header("Content-Type", "text/html; charset=utf-8")
        else:
            self.set_header("Content-Type", "application/octet-stream")
            self.set_header(
                "Content-Disposition",
                "attachment; filename*=UTF-8''" + url_escape(file.name, plus=False),
            )
        self.finish(file.read_bytes())

    async def put(self, name: str) -> None:
        """Take a file."""
        await self._act(lambda: self.project.add(name, bytes(self.body)))

    async def post(self, name: str) -> None:
        """Do what the page asks for."""
        if name == "stop":
            self.project.work.stop(self.project.chosen)
        elif name in ACTIONS:
            action, body = getattr(self.project, name), None
            with suppress(ValueError):  # None is refused
                body = json.loads(self.body or b"{}")
            facts = check_facts(action, body)
            await self._act(lambda: action(**facts))
        else:
            raise DataError.of("app.gone")

    async def _act(self, action: Callable[[], Any]) -> None:
        """Act on the project, once at a time, while others are answered; run the commands."""
        project = self.project
        async with self.settings["lock"]:
            if project.work.task is not None:
                raise DataError.of("app.busy")
            if steps := await asyncio.to_thread(action):
                project.work.begin(steps, project.chosen)
            project.touch()


async def follow(project: Project, lock: asyncio.Lock) -> None:
    """Give the companion the rows of an export as they come, if one is followed."""
    while project.make_export is not None:
        await asyncio.sleep(POLL)
        async with lock:
            await asyncio.to_thread(project.follow)


async def serve(
    folder: Path,
    host: str,
    port: int,
    announce: Callable[[str, str], None],
    make_export: Callable[[KindRows], GrowingExport] | None = None,
) -> None:
    """Serve the project of a folder until the process is asked to end.

    announce : gets the address to print, and one that opens once, for the browser to start: other
        users may see with which words it starts. make_export : as of `Project`.
    """
    project, ended, lock = Project(folder, make_export), asyncio.Event(), asyncio.Lock()
    token, once = secrets.token_urlsafe(24), secrets.token_urlsafe(24)
    try:
        sockets = bind_sockets(port, host)
    except (OSError, UnicodeError) as error:
        facts = {"host": host, "port": port, "reason": getattr(error, "strerror", None) or "name"}
        raise DataError.of("app.address", **facts) from error
    port = sockets[0].getsockname()[1]
    facts = {"project": project, "token": token, "host": host.lower(), "ended": ended}
    facts |= {"once": {once}}
    facts |= {"cookie": f"loopcal-{port}", "lock": lock, "log_function": lambda _: None}
    server = HTTPServer(Application([(r"/(.*)", Handler)], **facts), max_body_size=10**15)
    server.add_sockets(sockets)
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        with suppress(AttributeError, NotImplementedError):  # on Windows, Ctrl-C interrupts
            asyncio.get_running_loop().add_signal_handler(getattr(signal, name), ended.set)
    shown = f"[{host}]" if ":" in host else host
    if host == "0.0.0.0":  # all addresses, of which a tablet needs one
        listed = (each.address for of in psutil.net_if_addrs().values() for each in of)
        shown = next((a for a in listed if re.fullmatch(r"(?!127\.)[\d.]+", a)), host)
    address = f"http://{shown}:{port}/?token="
    announce(address + token, address + once)
    following = asyncio.create_task(follow(project, lock))
    try:
        await ended.wait()
    finally:
        project.work.stop(project.chosen)
        following.cancel()
        project.opened.close()
        server.stop()
        await asyncio.sleep(2 * TICK)  # pages that wait are told no more
