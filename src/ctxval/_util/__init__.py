"""Helpers for arrays, files, texts and processes. Nothing here knows of validation."""
