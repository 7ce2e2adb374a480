# SPDX-License-Identifier: Apache-2.0
"""`python -m loopcal`: the command line."""

import sys

from loopcal.cli import main

if __name__ == "__main__":
    sys.exit(main())
