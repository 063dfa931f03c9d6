"""Hostile input for the command line: stores, archives, tables, experiment files, arguments and systems, by a seed."""
