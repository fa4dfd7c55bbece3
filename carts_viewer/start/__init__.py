"""The start page: recent projects, a file browser confined to allowed folders, the sample, and New recording."""
