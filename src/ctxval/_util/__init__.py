"""What knows nothing of validation: arrays, files, texts, processes."""
