# SPDX-License-Identifier: Apache-2.0
"""`loopcal app` as a process, asked as by a browser or by anybody else."""

from __future__ import annotations

import http.client
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

pytest.importorskip("tornado")
EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42"


class Server:
    """A started `loopcal app`, whose temporary files are below `folder`."""

    def __init__(self, folder: Path, *words: str, browser: bool = False) -> None:
        folder.mkdir(exist_ok=True)
        self.folder, self.host = folder, "127.0.0.1"
        command = [sys.executable, "-m", "loopcal", "app", *words]
        command += [] if browser else ["--no-browser"]
        self.process = subprocess.Popen(
            command, env={**os.environ, "TMPDIR": str(folder)}, stderr=subprocess.PIPE, text=True
        )
        assert self.process.stderr is not None
        self.notes = ""
        while "http://" not in (line := self.process.stderr.readline()):
            self.notes += line
        self.address = line.split()[2]
        self.root, _, self.token = self.address.partition("?token=")
        self.port = int(self.root.rstrip("/").rpartition(":")[2])

    def ask(
        self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None
    ) -> tuple[int, dict[str, str], bytes]:
        """Return status, headers and body of an answer; by default with the token."""
        given = {"Cookie": f"loopcal-{self.port}={self.token}"} if headers is None else headers
        connection = http.client.HTTPConnection(self.host, self.port, timeout=60)
        body = json.dumps(body) if isinstance(body, dict) else body
        connection.request(method, path, body, given)
        answer = connection.getresponse()
        read = answer.read() if path != "/events" else answer.readline()
        connection.close()
        return answer.status, {k.lower(): v for k, v in answer.getheaders()}, read

    def tell(self, path: str, body: Any = None, method: str = "POST") -> str:
        """Return the sentence of a refusal; empty where there is none."""
        answer = self.ask(method, path, {} if body is None else body)[2]
        return json.loads(answer)["error"] if answer else ""

    @property
    def state(self) -> dict[str, Any]:
        """What a page shows now."""
        return json.loads(self.ask("GET", "/events")[2].removeprefix(b"data: "))

    def wait(self) -> dict[str, Any]:
        """Return what a page shows when no command runs."""
        while (state := self.state)["progress"] is not None:
            time.sleep(0.1)
        return state

    def list_children(self) -> list[psutil.Process]:
        return psutil.Process(self.process.pid).children(recursive=True)

    def end(self) -> tuple[int, str]:
        """Ask the process to end; return its exit code and what it printed on standard error."""
        self.process.terminate()
        error = self.process.communicate(timeout=60)[1]
        return self.process.returncode, error


@pytest.fixture
def start(tmp_path) -> Iterator[Callable[..., Server]]:
    """Start servers, which are ended after the test."""
    servers = []

    def begin(*words: str, browser: bool = False) -> Server:
        servers.append(Server(tmp_path / f"server{len(servers)}", *words, browser=browser))
        return servers[-1]

    yield begin
    for server in servers:
        server.process.kill()
        server.process.communicate()
