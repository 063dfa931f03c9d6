"""What is validated: the records, the five contracts, and the map p -> d(p)."""
