"""What goes over the wire, and everything that reaches into private parts of viser and websockets."""
