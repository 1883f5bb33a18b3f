"""The commands: each file has the options, the work and the closing sentence of one."""
