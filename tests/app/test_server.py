# SPDX-License-Identifier: Apache-2.0
"""`loopcal app` as a server: who may ask, names of files, limits, and what is left at its end."""

from __future__ import annotations

import asyncio
import http.client
import json
import os
import signal
import sys
import time
from pathlib import Path

import psutil
import pytest

from loopcal.app.project import Project, clean_name, recognize
from loopcal.cli.commands.session_commands import make_export
from loopcal.cli.entry_point import main
from loopcal.cli.hints import find_hint, load_hints
from loopcal.errors import DataError, FileError
from loopcal.findings import report_finding
from loopcal.planning.companion import Pace
from tests.app.conftest import EXAMPLE
from tests.io.test_probe_reports import MARLIN, REPRAP

DATA = (EXAMPLE / "measurements.csv").read_bytes()


def word(code: str) -> str:
    """Return the sentence of a finding without data."""
    return str(report_finding(code))


NAMES = {
    "printer.cfg": "printer.cfg",
    "../../etc/passwd": "passwd.txt",
    "..\\..\\boot.ini": "boot.ini",
    "/etc/cron.d/x.csv": "x.csv",
    "-o.csv": "o.csv",
    "--force": "force.txt",
    ".bashrc": "bashrc.txt",
    "choices": "choices.txt",
    "result": "result.txt",
    "a\0b\n.csv": "n.csv",
    "C:\\Users\\x\\h\u00f6hen.csv": "h\u00f6hen.csv",
    'a"; filename="b.csv': "b.csv",
    "x" * 300 + ".csv": ".csv",
    "\U0001f600" * 80 + ".csv": ".csv",
    "\u202e" * 70 + "x": "x.txt",
    "-=x.csv": "x.csv",
}


@pytest.mark.parametrize("name", NAMES)
def test_a_name_of_a_client_becomes_a_name_inside_the_folder(name: str, tmp_path) -> None:
    safe = clean_name(name)
    assert NAMES[name].removesuffix(".txt") in safe
    assert (tmp_path / safe).resolve().parent == tmp_path.resolve()
    assert Path(safe).suffix
    assert not safe.startswith(("-", "."))
    assert not set(safe) & set('/\\"\0\n:<>|?*')
    assert len(safe.encode()) < 255 - len("result.yaml")
    assert clean_name(safe) == safe  # as when a kept folder is read


@pytest.mark.parametrize("name", ["", "..", "///", "...", "- -"])
def test_a_name_of_nothing_is_refused(name: str) -> None:
    with pytest.raises(DataError) as caught:
        clean_name(name)
    assert caught.value.code == "app.unnamed"


KINDS = {
    "robot.yaml": ("family: gough\n", "robot"),
    "data.csv": ("pose,q1 [mm]\n", "data"),
    "printer.cfg": ("[printer]\nkinematics: delta\n", "klipper"),
    "config.g": (REPRAP, "reprap"),
    "bed.g": ("G30 P0 X0 Y0 Z-99999\n", "log"),
    "m503.txt": (f"echo:  {MARLIN}", "marlin"),
    "console.log": ("G32 bed probe heights: 0.1", "log"),
    "heightmap.csv": ("RepRapFirmware height map file v2", "log"),
    "samples.json": ('{"motor_pos_samp": []}', "hangprinter"),
    "plan.json": ("{}", "other"),
    "maslow.yaml": ("Maslow_tlX: -27.6\n", "maslow"),
    "loops.yaml": ("closed_loop: []\n", "other"),
    "arm.urdf": ("<robot/>", "urdf"),
}


@pytest.mark.parametrize("name", KINDS)
def test_the_kind_of_a_file_is_recognized(name: str, tmp_path) -> None:
    text, kind = KINDS[name]
    (tmp_path / name).write_text(text)
    assert recognize(tmp_path / name) == kind


def test_messages_name_what_people_gave(tmp_path) -> None:
    project = Project(tmp_path)
    project.add("config.g", REPRAP.encode())
    for made, given in {
        f"{tmp_path}/plan/measurements.csv:8": "sheet of the plan",
        "session/measurements.csv:8": "measured rows",
        "result/config.yaml:3": "config.g",
        "result/run": "config.g",
        "result/config.csv:3": "config.g",
        "own.csv:3": "own.csv:3",
    }.items():
        assert project.word(f"{made}: wrong") == f"{given}: wrong"
    project.add("console.log", b"G32 bed probe heights: 0.1")
    assert project.word("result/config.csv:3: wrong") == "console.log: wrong"


REFUSED = {
    "photo.jpg": (b"\xff\xd8\xff\xe0\0\x10JFIF", "binary"),
    "data.xlsx": (b"PK\3\4\x14\0", "archive"),
    "logs.txt.gz": (b"\x1f\x8b\x08\0", "archive"),
    "data.csv": ("pose,x [mm]\n".encode("utf-16"), "utf-16"),
    "empty.csv": (b" \r\n", "empty"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_command_reads_is_refused_with_what_it_is(name: str, tmp_path) -> None:
    project, (content, code) = Project(tmp_path), REFUSED[name]
    with pytest.raises(FileError) as caught:
        project.add(name, content)
    assert (caught.value.code, caught.value.path) == (f"app.{code}", Path(name))
    assert not project.chosen.kinds
    assert not project.has(name)


def test_files_that_are_not_used_are_named(tmp_path) -> None:
    project = Project(tmp_path)
    project.add("result.json", b"{}")
    assert "result.json" in project.chosen.messages[0]
    project.add("old.yaml", b"family: gough\n")
    project.add("new.yaml", b"family: gough\n")
    assert "new.yaml now, and not from old.yaml" in project.chosen.messages[0]
    project.add("data.csv", b"pose\n")
    project.add("console.log", b"text")
    assert project.robot == "new.yaml"
    assert project.describe()["unused"] == ["result.json", "old.yaml", "console.log"]
    project.change(remove="new.yaml")
    project.add("config.g", REPRAP.encode())  # whose log it is
    assert project.describe()["unused"] == ["result.json", "old.yaml"]


def test_a_pose_that_does_not_exist_is_not_left_out(tmp_path) -> None:
    project = Project(tmp_path)
    project.add("a.csv", b"pose,x [mm]\n1,2\n2,3\n")
    with pytest.raises(DataError) as caught:
        project.leave_out("7", True)
    assert caught.value.code == "app.gone"
    project.leave_out("2", True)
    assert project.chosen.dropped == ["2"]
    project.correct("a.csv", 3, 0, "two")  # its new name
    assert project.chosen.dropped == []


def test_macros_beside_a_configuration_are_logs_and_settings_stay_allowed_ones(tmp_path) -> None:
    project = Project(tmp_path)
    project.add("config.g", REPRAP.encode())
    project.add("sys.g", b"M665 L1 R1\n")
    assert project.chosen.kinds == {"config.g": "reprap", "sys.g": "log"}
    project.change(settings={"sigma_height": "0.02mm", "--corrected": "/etc/x", "robot": "/etc"})
    again = Project(tmp_path).chosen  # after a restart
    assert again == project.chosen
    words = project.calibrate()["import"]
    assert "--sigma-height=0.02mm" in words
    assert "--probes=sys.g" in words
    assert not any("/etc" in word for word in words)


CONFIG = b"[printer]\nkinematics: delta\n"


def test_what_is_given_decides_robot_data_and_commands_alike(tmp_path) -> None:
    project = Project(tmp_path)
    project.add("printer.cfg", CONFIG)
    assert (project.robot, project.data) == ("result/printer.yaml", ["result/printer.csv"])
    assert "--data" in project.calibrate()["import"]
    assert "--data" not in project.plan("height", "9", "", "")["import"]
    (tmp_path / "result" / "printer.yaml").touch()  # by the plan
    assert "--data" in project.calibrate()["import"]
    (tmp_path / "result" / "printer.csv").touch()
    assert "import" not in project.calibrate()
    project.add("hex.yaml", b"family: gough\n")
    assert (project.robot, project.data) == ("hex.yaml", [])
    with pytest.raises(DataError) as caught:
        project.calibrate()
    assert caught.value.code == "app.no-data"
    assert list(project.plan("height", "9", "", "")) == ["plan"]


def test_another_configuration_takes_the_place_of_the_first_and_says_so(tmp_path) -> None:
    project = Project(tmp_path)
    for name in ("printer.cfg", "printer.cfg", "printer2.cfg"):
        assert project.chosen.messages == []
        project.add(name, CONFIG)
    assert project.chosen.kinds == {"printer.cfg": "other", "printer2.cfg": "klipper"}
    assert "printer.cfg" in project.chosen.messages[0]
    assert project.program == "printer2.cfg"
    project.add("config.g", REPRAP.encode())
    assert project.program == "config.g"


def test_messages_on_the_page_do_not_speak_of_options(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    for is_page in (False, True):
        if is_page:
            monkeypatch.setenv("LOOPCAL_PAGE", "html")
        texts = [str(find_hint(code, None)) for code in load_hints()]
        for words in ("plan five-bar -o p --sigma-position=abc", "plan no.yaml -o p --what"):
            assert main(words.split()) == 1
            texts.append(capsys.readouterr().err)
        assert [text for text in texts if "--help" in text] == ([] if is_page else texts[-2:])
        assert not is_page or set(texts[:-2]) == {"None"}
        assert "abc" in texts[-2]
        assert ("--sigma-position" in texts[-2]) != is_page


@pytest.mark.slow
def test_a_page_gets_the_rows_that_it_shows(start) -> None:
    server = start()
    lines = DATA.decode().splitlines()
    many = "\n".join([*lines, *(f"m{i},{lines[-1].partition(',')[2]}" for i in range(5000))])
    server.tell("/many.csv", many.encode(), "PUT")
    for path, most in [("/rows", 15), ("/rows?all=1&sorted=0", 2000)]:
        status, headers, body = server.ask("GET", path)
        assert (status, headers["content-type"].partition(";")[0]) == (200, "application/json")
        (table,) = json.loads(body)["tables"]
        assert len(table["rows"]) == most < table["count"]
        assert len(body) < 400 * most + 1000  # 13 cells of 18 characters, quoted


def test_a_quarter_is_held_out_unless_the_data_or_a_person_state_others(tmp_path) -> None:
    project = Project(tmp_path)
    project.change(settings={"robot": "hexapod-42"})
    project.add("a.csv", b"pose,use\n1,fit\n2,fit\n")
    assert "--hold-out=0.25" in project.calibrate()["calibrate"]
    project.change(settings={"hold-out": "0"})
    assert "--hold-out=0" in project.calibrate()["calibrate"]
    project.change(settings={"hold-out": ""})
    project.add("b.csv", b"pose,use\n3,held-out\n")
    assert not any("hold-out" in word for word in project.calibrate()["calibrate"])


def test_without_the_extra_the_command_says_how_to_install_it(monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "tornado.web", None)
    assert main(["app", "--no-browser"]) == 1
    assert "pip install 'loopcal[app]'" in capsys.readouterr().err


@pytest.mark.slow
def test_only_the_page_with_the_token_is_answered(start) -> None:
    server = start()
    cookie = {"Cookie": f"loopcal-{server.port}={server.token}"}
    own = f"127.0.0.1:{server.port}"
    for headers, code in [
        ({}, 403),
        ({"Cookie": f"loopcal-{server.port}=wrong"}, 403),
        ({"Cookie": "loopcal-1=wrong"}, 403),
        (cookie, 200),
        (cookie | {"Host": f"localhost:{server.port}"}, 200),
        (cookie | {"Host": f"evil.example:{server.port}"}, 403),
        (cookie | {"Host": "127.0.0.1.evil.example"}, 403),
        (cookie | {"Host": ""}, 403),
        (cookie | {"Origin": f"http://{own}"}, 200),
        (cookie | {"Origin": "http://evil.example"}, 403),
        (cookie | {"Origin": "null"}, 403),
        (cookie | {"Origin": f"http://127.0.0.1:{server.port + 1}"}, 403),
        (cookie | {"Host": "evil.example", "Origin": "http://evil.example"}, 403),
    ]:
        for method, path in [("GET", "/"), ("GET", "/rows"), ("POST", "/stop"), ("GET", "/events")]:
            answer = server.ask(method, path, b"" if method == "POST" else None, headers)
            assert answer[0] == code, (headers, path, answer)
            assert "frame-ancestors 'none'" in answer[1]["content-security-policy"]
            assert answer[1]["cache-control"] == "no-store"
    status, headers, page = server.ask("GET", f"/?token={server.token}", headers={})
    assert (status, page[:15]) == (200, b"<!doctype html>")
    assert {"HttpOnly", "SameSite=Strict"} <= set(headers["set-cookie"].split("; "))
    assert server.ask("GET", "/?token=wrong", headers={})[0] == 403
    assert server.ask("GET", "/", headers={})[2].decode() == word("app.denied")
    assert server.end() == (0, "")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="a script stands for the browser")
def test_the_address_of_the_started_browser_opens_once(start, tmp_path, monkeypatch) -> None:
    script, seen = tmp_path / "browser", tmp_path / "seen"
    script.write_text(f'#!/bin/sh\necho "$1" > {seen}.part && mv {seen}.part {seen}\n')
    script.chmod(0o700)
    monkeypatch.setenv("BROWSER", str(script))
    monkeypatch.setenv("DISPLAY", ":0")
    server = start(browser=True)
    while not seen.exists():
        time.sleep(0.05)
    path = "/" + seen.read_text().strip().removeprefix(server.root)
    assert server.token not in path
    assert server.ask("GET", path, headers={})[0] == 200
    assert server.ask("GET", path, headers={})[0] == 403


@pytest.mark.slow
def test_no_path_leads_out_of_the_list(start, tmp_path) -> None:
    server = start()
    secret = tmp_path / "secret.txt"
    secret.write_text("secret")
    for path in [
        "/../secret.txt", "/..%2fsecret.txt", f"/{secret}", "//etc/passwd", "/choices", "/app.py",
        "/result/run/../../choices", "/server.py", "/%2e%2e/%2e%2e/secret.txt", "/result/run",
    ]:  # fmt: skip
        status, _, body = server.ask("GET", path)
        assert status in (400, 404), path
        assert b"secret" not in body.replace(b"secret.txt", b"")
    for name in ["..%2f..%2fevil.csv", "/etc/evil.csv", "%00evil.csv", "a/../../evil.csv"]:
        assert server.tell(f"/{name}", DATA, "PUT") == ""
    assert all(name.endswith("evil.csv") for name in server.state["kinds"])
    folder = next(server.folder.iterdir())
    assert {path.parent for path in folder.rglob("*evil.csv")} == {folder}
    assert not Path("/etc/evil.csv").exists()
    for path, body in [
        ("/__class__", b"{}"), ("/store", b"{}"), ("/change", b"[]"), ("/change", b"{"),
        ("/change", b'{"kinds": 1}'), ("/correct", b"\xff\xfe"),
        ("/plan", b'{"instrument": "x", "poses": "", "accuracy": "", "sigma": ""}'),
    ]:  # fmt: skip
        assert server.ask("POST", path, body)[0] in (400, 404), (path, body)
    for path, body in [
        ("/correct", {"file": "../x", "line": 1, "column": 1, "text": ""}), ("/nothing", {}),
        ("/calibrate", {}), ("/measure", {}),
    ]:  # fmt: skip
        assert server.tell(path, body), path
    assert server.end()[0] == 0


@pytest.mark.slow
def test_large_and_many_files_are_refused(start) -> None:
    server = start()
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    connection.putrequest("PUT", "/large.csv")
    connection.putheader("Cookie", f"loopcal-{server.port}={server.token}")
    connection.putheader("Content-Length", str(100_000_000))
    connection.endheaders()  # the body is not awaited
    answer = connection.getresponse()
    assert answer.status == 400
    assert "the limit is 50" in json.loads(answer.read())["error"]
    chunks = (bytes(10**6) for _ in range(60))  # of no stated length
    with pytest.raises((OSError, AssertionError)):
        assert server.ask("PUT", "/chunks.csv", chunks)[0] == 200
    for i in range(50):
        assert server.tell(f"/{i}.csv", b"pose\n", "PUT") == ""
    assert "the limit is 50" in server.tell("/51.csv", b"pose\n", "PUT")
    assert server.tell("/7.csv", b"pose\n", "PUT") == ""  # replaces one
    assert len(server.state["kinds"]) == 50
    assert server.end()[0] == 0


def begin_work(server) -> None:
    server.tell("/measurements.csv", DATA, "PUT")
    server.tell("/change", {"settings": {"robot": "hexapod-42"}})
    assert server.tell("/calibrate") == ""
    for _ in range(50):
        if server.list_children():
            return
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT", "SIGHUP"])
def test_an_end_during_work_leaves_no_folder_and_no_process(start, name: str) -> None:
    server = start()
    begin_work(server)
    children = server.list_children()
    assert children
    os.kill(server.process.pid, getattr(signal, name))
    error = server.process.communicate(timeout=60)[1]
    assert (server.process.returncode, error) == (0, "")
    assert list(server.folder.iterdir()) == []
    assert not [child for child in children if child.is_running()]


@pytest.mark.slow
def test_work_is_stopped_and_another_waits(start) -> None:
    server = start()
    begin_work(server)
    assert server.tell("/calibrate") == word("app.busy")
    assert server.tell("/more.csv", b"pose\n", "PUT") == word("app.busy")
    children = server.list_children()
    assert server.tell("/stop") == ""
    state = server.wait()
    assert "calibrate" not in state["pages"]
    assert not [child for child in children if child.is_running()]
    assert server.tell("/stop") == ""
    assert server.tell("/calibrate") == ""
    while "calibrate" not in (state := server.state)["pages"] and state["progress"] is not None:
        time.sleep(0.1)
    assert "42 parameters" in state["pages"]["calibrate"]
    assert server.tell("/stop") == ""  # no report is read


def run_script(project: Project, script: Path, text: str, stop_after: float = 60) -> None:
    """Run a script in place of the commands of a calibration, perhaps stop it."""

    async def run() -> None:
        work = project.work
        work.begin(project.calibrate(), project.chosen)
        assert work.task is not None
        await asyncio.wait([work.task], timeout=stop_after)
        work.stop(project.chosen)
        while work.process is not None:
            await asyncio.sleep(0.01)

    script.write_text(f"#!/bin/sh\n{text}")
    script.chmod(0o700)
    asyncio.run(run())


@pytest.mark.skipif(sys.platform == "win32", reason="a script stands for the commands")
def test_what_is_stopped_or_killed_leaves_no_page_of_the_result_before(
    tmp_path, monkeypatch
) -> None:
    script = tmp_path / "script"
    monkeypatch.setattr(sys, "executable", str(script))
    (tmp_path / "project").mkdir()
    project = Project(tmp_path / "project")
    project.add("measurements.csv", DATA)
    project.change(settings={"robot": "hexapod-42"})
    for text, code, stop_after in [("sleep 9", "stopped", 0.1), ("kill -9 $$", "killed", 60)]:
        run_script(project, script, "echo good")
        assert project.chosen.pages == {"calibrate": "good\n", "report": "good\n"}
        assert project.chosen.messages == []
        run_script(project, script, text, stop_after)
        assert (project.chosen.pages, project.chosen.codes) == ({}, {})
        assert [word(f"app.{code}") in line for line in project.chosen.messages] == [True]
        assert Project(project.folder).chosen == project.chosen


def test_another_plan_waits_until_measured_rows_are_removed(tmp_path) -> None:
    project = Project(tmp_path)
    lines = DATA.decode().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("pose,")) + 1
    empty = [",".join(line.split(",")[:7] + [""] * 6) for line in lines[first:]]
    project.add("measurements.csv", "\n".join([*lines[:first], *empty, ""]).encode())
    project.change(settings={"robot": "hexapod-42"})
    plan = ("position", "30", "", "5um")
    assert "plan" in project.plan(*plan)
    for _ in range(2):
        assert project.measure() == {}
        assert project.session is not None
        project.tell("", "1", ["0"] * len(project.session.journal.columns))
        project.finish()
        assert project.describe()["is_begun"]
        with pytest.raises(DataError) as caught:
            project.plan(*plan)
        assert caught.value.code == "app.measured"
        project.discard()
        assert not project.describe()["is_begun"]
        assert project.data == ["measurements.csv"]
        assert "plan" in project.plan(*plan)


SHEET = """# kind: position
# noise: {"*": 20 um}
pose,left [deg],right [deg],x [mm],y [mm],z [mm]
1,120,60,,,
2,110,50,,,
3,130,70,,,
"""


def test_the_companion_takes_what_the_command_takes(tmp_path) -> None:
    export = tmp_path / "points.txt"
    given = {"follow": export, "profile": "leica", "unit": None, "decimal": None, "by_order": False}
    (tmp_path / "project").mkdir()
    project = Project(tmp_path / "project", make_export(given))
    project.add("sheet.csv", SHEET.encode())
    project.change(settings={"robot": "five-bar", "goal": "50um"})
    for speed, code in [("fast", "session.no-number"), ("1000,5", "session.speed-alone")]:
        project.change(settings={"speed": speed})
        with pytest.raises(DataError) as caught:
            project.measure()
        assert caught.value.code == code
    project.change(settings={"minutes": "2", "check-every": "7"})
    assert project.measure() == {}
    session = project.session
    assert session is not None
    assert session.task.pace == Pace(2.0, 1.0005)
    assert session.task.check_every == 7
    assert session.task.problem.options.goal == pytest.approx(50e-6)
    for wrong in ("1,234.5", "1 234", "x"):
        project.tell("", "1", ["270", wrong, "-"])
        assert f"{wrong!r} is not a number" in str(project.said)
    assert not session.journal.visits
    project.tell("", "1", [" 1,5", "270.2", "-"])
    export.write_text("2 10 270 0\n3 5")
    project.follow()
    project.follow()
    taken = [(visit.pose, *visit.cells.values()) for visit in session.journal.visits]
    assert taken == [("1", "1.5", "270.2", ""), ("2", "10", "270", "0")]
    project.finish()


@pytest.mark.slow
def test_the_next_start_removes_the_folder_of_a_killed_server(start) -> None:
    server = start()
    begin_work(server)
    (private,) = server.folder.iterdir()
    assert private.stat().st_mode & 0o077 == 0
    server.process.kill()
    server.process.wait()
    again = type(server)(server.folder)
    try:
        (other,) = server.folder.iterdir()
        assert other != private
        third = type(server)(server.folder)  # a living server keeps its own
        assert third.end() == (0, "")
        assert other.is_dir()
    finally:
        assert again.end() == (0, "")


@pytest.mark.slow
def test_a_kept_folder_is_gone_on_with(start, tmp_path) -> None:
    words = ("--keep", str(tmp_path / "kept"))
    first = start(*words)
    first.tell("/measurements.csv", DATA, "PUT")
    first.tell("/change", {"settings": {"robot": "hexapod-42"}})
    first.tell("/leave_out", {"pose": "7", "is_out": True})
    assert first.end() == (0, "")
    state = start(*words).state
    assert (state["kinds"], state["dropped"]) == ({"measurements.csv": "data"}, ["7"])
    assert (tmp_path / "kept" / "measurements.csv").read_bytes() == DATA


@pytest.mark.parametrize("words", ["--host no.such.name.invalid", "--host 192.0.2.1", "--port 1"])
def test_an_address_that_is_not_ours_is_refused(words: str, monkeypatch, capsys) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    if "--port" in words:  # root may
        monkeypatch.setattr("loopcal.app.server.bind_sockets", refuse)
    assert main(["app", "--no-browser", *words.split()]) == 1
    host, port = (words.split()[1], 0) if "--host" in words else ("127.0.0.1", 1)
    assert f"{host}, port {port}" in capsys.readouterr().err


def test_a_folder_with_other_content_is_refused_and_kept(tmp_path, capsys) -> None:
    file = tmp_path / "result" / "mine.txt"
    file.parent.mkdir()
    file.write_text("mine")
    assert main(["app", "--no-browser", "--keep", str(tmp_path)]) == 1
    assert word("session.other-content") in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["result"]
    assert file.read_text() == "mine"


CHOICES = [
    {"foo": 1},
    [],
    7,
    {"kinds": []},
    {"kinds": {"a.csv": 1}},
    {"kinds": {"a.csv": "wrong"}},
    {"kinds": {"": "data"}},
    {"kinds": {"../secret.txt": "data"}},
    {"kinds": {"/etc/passwd": "data"}},
    {"kinds": {"choices": "data"}},
    {"dropped": [1]},
    {"runs": "1"},
    {"runs": True},
    {"is_measured": 1},
    {"codes": {"plan": True}},
    {"settings": None},
]


@pytest.mark.parametrize("choices", CHOICES, ids=str)
def test_choices_that_loopcal_did_not_write_are_refused(choices: object, tmp_path) -> None:
    (tmp_path / "choices").write_text(json.dumps(choices))
    with pytest.raises(FileError) as caught:
        Project(tmp_path)
    assert caught.value.code == "app.choices"


@pytest.mark.parametrize("name", ["a.csv", "choices", "result/files", "session"])
def test_a_kept_folder_with_links_is_refused(name: str, tmp_path) -> None:
    folder = tmp_path / "kept"
    (folder / name).parent.mkdir(parents=True)
    (tmp_path / "elsewhere").write_text('{"kinds": {"a.csv": "data"}}')
    (folder / "choices").write_text('{"kinds": {"a.csv": "data"}}')
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FileError) as caught:
        Project(folder)
    assert caught.value.code == "app.choices"


@pytest.mark.slow
def test_names_of_all_languages_are_kept(start) -> None:
    server = start("--host", "::1")
    server.host = "::1"
    name = "\u6e2c\u5b9a #1 50%.csv"
    path = "/" + "".join(f"%{byte:02x}" for byte in name.encode())
    assert server.tell(path, DATA, "PUT") == ""
    assert list(server.state["kinds"]) == [name]
    status, headers, content = server.ask("GET", path)
    assert (status, content) == (200, DATA)
    assert headers["content-disposition"].endswith("''%E6%B8%AC%E5%AE%9A%20%231%2050%25.csv")


@pytest.mark.slow
def test_an_open_network_is_warned_of(start) -> None:
    server = start("--host", "0.0.0.0")
    assert server.ask("GET", "/", None, {"Host": f"evil.example:{server.port}"})[0] == 403
    assert word("app.open-network") in server.notes
    server.host = server.root.split("/")[2].rpartition(":")[0]
    listed = [each.address for of in psutil.net_if_addrs().values() for each in of]
    assert server.host in listed or not any(a.count(".") == 3 and a[:4] != "127." for a in listed)
    assert server.ask("GET", "/")[0] == 200


@pytest.mark.slow
def test_downloads_are_those_of_the_commands_byte_for_byte(start, tmp_path, monkeypatch) -> None:
    from tests.cli.test_delta_page_firmware import POINTS, add_noise, make_truth, probe

    folder = tmp_path / "commands"
    folder.mkdir()
    monkeypatch.chdir(folder)
    Path("config.g").write_text(REPRAP)
    robot, truth = make_truth("config.g")
    cells = " ".join(f"{h:.3f}" for h in add_noise(probe(robot, truth, POINTS)))
    Path("console.log").write_text(f"G32 bed probe heights: {cells}, mean 0, deviation 0")
    points = [f"G30 P{i} X{x:.3f} Y{y:.3f} Z-99999" for i, (x, y) in enumerate(POINTS)]
    Path("bed.g").write_text("\n".join(points) + " S-1\n")
    server = start()
    for name in ("config.g", "bed.g", "console.log"):
        assert server.tell(f"/{name}", Path(name).read_bytes(), "PUT") == ""
    assert server.tell("/change", {"settings": {"hold-out": "0.4"}}) == ""
    assert server.tell("/calibrate") == ""
    Path("result/files").mkdir(parents=True)
    probes = "--probes=bed.g --probes=console.log"
    for words in (
        f"import config.g --format reprap -o result/config.yaml --data result/config.csv {probes}",
        "calibrate result/config.yaml result/config.csv -o result/run --hold-out=0.4",
        "report result/run -o result/files/report.html",
        "export result/run --format reprap --into config.g -o result/files/config.g",
    ):
        assert main(words.split()) == 0
    state = server.wait()
    assert [m for m in state["messages"] if "note" not in m] == []
    assert len(state["downloads"]) == 6
    for name in state["downloads"]:
        assert server.ask("GET", f"/{name}")[2] == Path(name).read_bytes(), name
    kept = server.ask("GET", "/result/files/config.g")[1]["content-disposition"]
    assert kept == "attachment; filename*=UTF-8''config.g"
    shown = server.ask("GET", "/result/files/report.html?show=1")[1]
    assert shown["content-security-policy"].startswith("sandbox allow-scripts; ")


WRONG = {
    "latin.csv": "pose,x [mm] \u00e4\n".encode("latin-1"),
    "robot.csv": b"family: gough\n",
    "other.csv": b"pose,q1 [mm],q2 [mm]\n1,2,3\n",
}


@pytest.mark.slow
def test_messages_of_wrong_files_are_those_of_the_command(
    start, tmp_path, monkeypatch, capsys
) -> None:
    server = start()
    monkeypatch.chdir(tmp_path)
    server.tell("/change", {"settings": {"robot": "five-bar"}})
    assert server.tell("/numpy.py", b"raise SystemExit(7)", "PUT") == ""  # imported by nobody
    for name, content in WRONG.items():
        Path(name).write_bytes(content)
        assert server.tell(f"/{name}", content, "PUT") == ""
        assert server.tell("/calibrate") == ""
        capsys.readouterr()
        assert main(["calibrate", "five-bar", name, "-o", "result/run"]) == 1
        state = server.wait()
        assert state["messages"] == capsys.readouterr().err.splitlines()
        assert state["codes"]["calibrate"] == 1
        assert server.tell("/change", {"remove": name}) == ""
