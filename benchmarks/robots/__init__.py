"""Models on real robots, against recordings that others have published and this repository does not hold."""
