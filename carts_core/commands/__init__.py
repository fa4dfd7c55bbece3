"""The subcommands of `carts`, one module each."""
