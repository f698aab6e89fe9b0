"""Dataset -> Figure; the only matplotlib. One module per kind of study."""
