"""Communication with tabs, and all use of private APIs of viser and websockets."""
