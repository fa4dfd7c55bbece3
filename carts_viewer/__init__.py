"""The browser app: browse a sequence, move the arms by hand, run the optimizer, export masks."""
