"""What a study shows: tables in the terminal, figures, the explorer page."""
