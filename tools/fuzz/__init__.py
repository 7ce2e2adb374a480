# SPDX-License-Identifier: Apache-2.0
"""Random inputs for the command line: damaged files of every kind and options of every command.

An input is a folder of files and one command line, made from a seed number alone. `cases.py` makes
it from the valid files of `corpus.py`, `execution.py` runs it, and `verdict.py` states what is
wrong with the answer. `campaign.py` runs many of them in processes of their own.
"""
