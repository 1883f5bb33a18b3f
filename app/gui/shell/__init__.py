"""The shell of the window, which exists once: its menus, docks and dialogs, and the commands that it sends."""
