"""`python -m ss_flow`: the same as the command `ss-flow`."""

from importlib import import_module

# By its name, since the command line stands on a floor above this one.
import_module("ss_flow.flows.cli.main").entry()
