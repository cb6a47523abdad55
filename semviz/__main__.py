"""``python -m semviz``: the command ``semviz``."""

from semviz.cli import main

if __name__ == "__main__":
    main()
