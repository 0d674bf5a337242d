"""``python -m dcon.cli``."""

from dcon.cli import main

if __name__ == "__main__":  # a process of a sweep may import this, too
    main()
