"""Decoders of foreign file formats that are based on libraries; they run in the child process of `files.decoding`."""
