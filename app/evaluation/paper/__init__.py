"""The tables of the paper: its numbers beside ours."""
