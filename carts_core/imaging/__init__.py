"""Images in the working size: resizing, filters, windows and dehazing."""
