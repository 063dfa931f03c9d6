"""``python -m ctxval`` is the command ``ctxval``."""

from ctxval.cli import main

main()
