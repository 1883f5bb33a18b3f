"""The Qt window: it shows results and emits intents; it computes nothing."""
