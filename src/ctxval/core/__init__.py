"""The records of a validation, the contracts of its parts, and the map p -> d(p)."""
