"""``python -m ctxval.cli``."""

from ctxval.cli import main

main()
