"""Decoders of foreign file formats, based on libraries and run in the child process of `files.decoding`."""
