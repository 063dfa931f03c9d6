"""Power cuts: what a campaign writes and syncs is recorded, and every disk that a cut could leave is opened again."""
