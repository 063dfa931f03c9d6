"""Studies of models: whether M itself completes the tasks; replay, fit, compare and refine."""
