"""What makes networks and figures; nobody who uses the library imports it."""
