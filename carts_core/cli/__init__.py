"""The `carts` command, one module per subcommand; what takes long to import is imported when they run."""

from .command_line import main as main
