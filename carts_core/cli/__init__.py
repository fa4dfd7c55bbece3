"""The `carts` command. Slow modules are imported when a subcommand runs."""

from ..package_imports import gc_paused

with gc_paused():
    from .command_line import main as main
