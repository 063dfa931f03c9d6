"""Gaussian processes; they know numbers alone."""
