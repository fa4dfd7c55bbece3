"""Communication with tabs, and all use of private parts of viser and websockets."""
