"""Images at the working size: resizing, filters, windows and dehazing."""
