"""The browser app: look at a sequence, move the arms by hand, let the optimizer bring them back, take the masks."""
