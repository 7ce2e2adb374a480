# SPDX-License-Identifier: Apache-2.0
"""`loopcal` and `python -m loopcal`: the command line.

Ctrl-C is answered in a sentence from the first import on; the command line itself answers it once
it runs. The end that the system asks for, as `kill` and `timeout` do, is answered in the same way.
"""

import gc
import signal
import sys

COLLECTED_AFTER = 300_000
"""New objects after which Python looks for unused ones. Its 700 are reached a hundred times while
packages are imported and figures drawn, where nothing becomes unused. A calibration makes fewer
than 200,000 objects.
"""


def run() -> int:
    """Run the command line and return its exit code."""
    gc.set_threshold(COLLECTED_AFTER)
    for name in ("SIGTERM", "SIGHUP"):  # the latter is ignored below nohup
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)
    try:
        from loopcal.cli.entry_point import main

        return main()
    except KeyboardInterrupt:  # before the first command ran, or after the last word was printed
        sys.stderr.write("loopcal: stopped.\n")
        return 1
    finally:
        gc.freeze()  # Python looks through all objects once more when it ends; nothing is gained


if __name__ == "__main__":
    sys.exit(run())
