"""Entry point of `python -m carts_core.cli`."""

from .command_line import main

if __name__ == "__main__":
    main()
