"""The shell of the window: its menus, docks and dialogs, and the commands that it sends."""
