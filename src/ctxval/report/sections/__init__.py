"""The sections of a report: each has a title and a function that renders it."""
