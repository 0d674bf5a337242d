"""``python -m pmutools.cli``."""

from pmutools.cli import main

main()
