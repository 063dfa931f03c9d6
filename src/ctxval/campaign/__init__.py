"""The loop: choose a task, execute it, measure the distance, store the trial."""
