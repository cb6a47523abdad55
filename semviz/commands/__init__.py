"""One module per group of commands.

A command is a frozen dataclass: its fields are the options, and ``run`` returns the exit status.
Modules import nothing heavy before ``run``, because ``semviz --help`` imports them all.
"""
