"""Qt window: shows results and emits the user's intents."""
