"""Decoders of foreign formats that libraries read; each runs in the child process of `carts_core.files.decoding`."""
