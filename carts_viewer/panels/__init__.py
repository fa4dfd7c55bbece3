"""The panels: each builds its widgets, turns input into intents, and shows a state."""
