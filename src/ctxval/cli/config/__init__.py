"""An experiment from a file or from a name."""
