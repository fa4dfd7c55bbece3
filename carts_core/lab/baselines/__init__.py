"""Networks of others on our frames: the rows of the paper's table that look at images alone, or at a rendering, too."""
