"""The application: what chooses, schedules, stores and shows."""
