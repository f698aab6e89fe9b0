"""The standing guard: the declared range of every field, what every result must satisfy, and how scenes end."""
