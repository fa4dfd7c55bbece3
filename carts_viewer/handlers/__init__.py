"""The handlers of intents: each takes the intents of one kind and changes the state and the project."""
