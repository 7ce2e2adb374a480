# SPDX-License-Identifier: Apache-2.0
"""The distribution functions of scipy that loopcal uses, without the rest of `scipy.special`.

`import scipy.special` takes twice as long as `import numpy`, because the package prepares all of
its functions for other array libraries, and imports numpy.f2py for that. The functions themselves
are compiled, in a module that takes a tenth of the time. A calibration on the command line spent a
sixth of its time there. So that module is imported alone, where this is possible.
"""

from __future__ import annotations

import sys
import threading
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scipy.special import bdtr as bdtr
    from scipy.special import bdtrc as bdtrc
    from scipy.special import betainc as betainc
    from scipy.special import betaincinv as betaincinv
    from scipy.special import chdtrc as chdtrc
    from scipy.special import chdtri as chdtri
    from scipy.special import chndtr as chndtr
    from scipy.special import chndtrinc as chndtrinc
    from scipy.special import fdtrc as fdtrc
    from scipy.special import fdtri as fdtri
    from scipy.special import gammaln as gammaln
    from scipy.special import ndtr as ndtr
    from scipy.special import ndtri as ndtri
    from scipy.special import stdtr as stdtr
    from scipy.special import stdtrit as stdtrit
else:

    def __getattr__(name: str) -> Any:
        """Return a function of scipy.special."""
        if name.startswith("__"):  # `from ... import` asks every time whether this is a package
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        function = getattr(_import_functions(), name)
        globals()[name] = function
        return function


PACKAGE = "scipy.special"
COMPILED = f"{PACKAGE}._ufuncs"
"""The module of the compiled functions, which every scipy since 1.0 has under this name."""


def _import_functions() -> ModuleType:
    """Return the compiled functions, or the package where they cannot be imported alone.

    The package only has to tell where its modules are, so it is found, but not executed. Until the
    module is imported, another thread would see the empty package; so this is done in a process
    with one thread. Whoever imports scipy.special later gets all of it, with the same functions.
    """
    if PACKAGE in sys.modules or threading.active_count() > 1:
        return import_module(PACKAGE)
    spec = find_spec(PACKAGE)
    if spec is None:
        return import_module(PACKAGE)
    sys.modules[PACKAGE] = module_from_spec(spec)
    try:
        return import_module(COMPILED)
    except ImportError:  # a scipy that is arranged otherwise
        pass
    finally:
        del sys.modules[PACKAGE]
    return import_module(PACKAGE)
