"""The `carts` command. Slow modules are imported when a subcommand runs."""

from .command_line import main as main
