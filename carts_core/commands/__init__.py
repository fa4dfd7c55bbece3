"""The subcommands of `carts`, one module each; what takes long to import is imported when they run."""
