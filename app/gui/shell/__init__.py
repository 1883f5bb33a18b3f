"""What exists once: the window with its menus, docks and dialogs, and the commands that it sends."""
