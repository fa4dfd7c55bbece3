"""The `carts` command. Modules that take long to import are imported when a subcommand runs."""

from .command_line import main as main
