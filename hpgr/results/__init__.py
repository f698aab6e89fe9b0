"""What comes out of a run: the table of its variables, flags, and figures computed from a Dataset."""
