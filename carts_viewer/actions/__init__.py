"""Actions of a user: intents, and the handlers that carry them out."""
