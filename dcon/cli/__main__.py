"""``python -m dcon.cli``."""

from dcon.cli import main

main()
