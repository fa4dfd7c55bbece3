"""Panels: each builds widgets, converts input into intents, and shows a state."""
