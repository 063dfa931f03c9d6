"""Our searches beside what others use, on the same functions with the same seeds."""
