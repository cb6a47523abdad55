"""One module a command: its options as a frozen dataclass, its work as ``run() -> exit status``.

Modules here import nothing heavy before ``run``: ``semviz --help`` reads them all.
"""
