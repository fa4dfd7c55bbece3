"""The panels: each builds its widgets, turns what people do into intents, and shows a state."""
