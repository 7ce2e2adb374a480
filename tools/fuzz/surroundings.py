# SPDX-License-Identifier: Apache-2.0
"""Settings that no answer may depend on: files of other programs in the current folder, variables
of the environment, and the locale.
"""

from __future__ import annotations

import contextlib
import locale
import os
import time
from collections.abc import Iterator, Mapping
from random import Random

DRAWING = b"text.usetex: True\nfont.family: serif\nsavefig.dpi: 30\naxes.facecolor: red\n"

FILES = {
    "matplotlibrc": (DRAWING, b"\xff\xfe", b"backend: none\n", b"no: colon: here\n"),
    ".matplotlib/matplotlibrc": (DRAWING,),
    "matplotlib/matplotlibrc": (DRAWING,),
    ".config/matplotlib/matplotlibrc": (DRAWING,),
    "matplotlib.py": (b"raise SystemExit(7)\n",),
    "numpy.py": (b"raise SystemExit(7)\n",),
    "loopcal_native.py": (b"raise SystemExit(7)\n",),
    "sitecustomize.py": (b"raise SystemExit(7)\n",),
    "usercustomize.py": (b"raise SystemExit(7)\n",),
    "site.cfg": (b"[openblas]\nlibraries = none\n",),
    "pyproject.toml": (b"[tool.loopcal]\nseed = 7\n", b"[", b"\xff"),
    "setup.cfg": (b"[metadata]\nname = loopcal\n[options.entry_points]\nloopcal.losses = a=b\n",),
    "loopcal.toml": (b"seed = 7\n",),
    "loopcal.yaml": (b"seed: 7\n",),
    ".loopcal": (b"seed: 7\n",),
    ".env": (b"LOOPCAL_ENGINE=none\n",),
    ".sqliterc": (b".quit\n",),
    ".netrc": (b"machine x login y\n",),
    "entry_points.txt": (b"[loopcal.engines]\nnone = none\n",),
    "loopcal-9.dist-info/entry_points.txt": (b"[loopcal.losses]\nnone = none:none\n",),
    "desktop.ini": (b"[.ShellClassInfo]\r\n",),
    "Thumbs.db": (b"\xd0\xcf\x11\xe0",),
    ".DS_Store": (b"\x00\x00\x00\x01Bud1",),
}
"""Names of files that libraries, tools and file managers look for or leave, and contents."""

VARIABLES = {
    "MATPLOTLIBRC": (".", "matplotlibrc", "/dev/null", "missing"),
    "MPLBACKEND": ("none", "module://none", "TkAgg", ""),
    "MPLCONFIGDIR": (".matplotlib", "/missing", ""),
    "OPENBLAS_NUM_THREADS": ("7", "-1", "x"),
    "OPENBLAS_VERBOSE": ("2",),
    "OMP_NUM_THREADS": ("7", "0", "x"),
    "OMP_DISPLAY_ENV": ("TRUE",),
    "MKL_NUM_THREADS": ("7",),
    "NPY_DISABLE_CPU_FEATURES": ("AVX2",),
    "TZ": ("Asia/Tokyo", "America/St_Johns", "none", ":/dev/zero", ""),
    "LANG": ("tr_TR.UTF-8", "xx", "de_DE.ISO-8859-1"),
    "LANGUAGE": ("de", "tr:de"),
    "PYTHONWARNINGS": ("error",),
    "PYTHONUTF8": ("0",),
    "PYTHONIOENCODING": ("ascii",),
    "SOURCE_DATE_EPOCH": ("86400", "-1", "x"),
    "HOME": ("/missing", "", "."),
    "XDG_CONFIG_HOME": (".config", "/missing"),
    "XDG_CACHE_HOME": ("/missing",),
    "EDITOR": ("false",),
    "BROWSER": ("false",),
    "USER": ("\U0001f916", ""),
    "NO_COLOR": ("1",),
    "FORCE_COLOR": ("1",),
    "CLICOLOR_FORCE": ("1",),
    "TERM": ("dumb", "xterm-256color", ""),
    "LOOPCAL_SEED": ("7",),
}
"""Variables of the environment, and values."""

LOCALES = ("de_DE.UTF-8", "tr_TR.UTF-8", "de_DE.ISO-8859-1", "C")
"""Locales, of which the system may lack some."""


def draw_surroundings(rng: Random) -> tuple[dict[str, bytes], dict[str, str]]:
    """Return files to add to a folder, and variables; LC_ALL is a locale that is set, too."""
    names = rng.sample(sorted(FILES), rng.choice([1, 2, 5]))
    variables = rng.sample(sorted(VARIABLES), rng.choice([0, 1, 3]))
    drawn = {name: rng.choice(VARIABLES[name]) for name in variables}
    if rng.random() < 0.4:
        drawn["LC_ALL"] = rng.choice(LOCALES)
    return {name: rng.choice(FILES[name]) for name in names}, drawn


@contextlib.contextmanager
def set_variables(variables: Mapping[str, str]) -> Iterator[None]:
    """Let the body run with these variables and the locale that they name."""
    before = {name: os.environ.get(name) for name in variables}
    number_format = locale.setlocale(locale.LC_ALL)
    os.environ.update(variables)
    with contextlib.suppress(locale.Error):
        locale.setlocale(locale.LC_ALL, variables.get("LC_ALL", number_format))
        locale.setlocale(locale.LC_MESSAGES, "C")  # which Python does not change
    time.tzset()
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            os.environ.update({} if value is None else {name: value})
        locale.setlocale(locale.LC_ALL, number_format)
        time.tzset()
