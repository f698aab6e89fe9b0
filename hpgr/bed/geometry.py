"""The bed between the rolls: gap curve and cubic streamlines (paper section 2.2, figure 3a).

y is the height above the minimum gap, x the distance from the mid-plane. The flow is symmetric, so only
0 <= x is described.
"""

import math
from typing import NamedTuple

import numpy as np

_HEIGHTS = np.linspace(0.0, 1.0, 201)


class Geometry(NamedTuple):
    """Outermost streamline X(y) = half_gap + b y**2 + c y**3 and the labels of the computed ones."""

    half_gap: float  # half the minimum gap, m
    height: float  # H of the bed above the minimum gap, m; 0 if gap and entry gap are equal
    b: float  # coefficients of the cubic, 1/m
    c: float  # and 1/m2
    radius: float  # of the rolls, m
    xi: np.ndarray  # (streamline,) centres of the stream tubes as fractions of the outermost streamline

    def outer(self, y):
        """Return X(y), the half width of the bed at height y, m."""
        return self.half_gap + y * y * (self.b + self.c * y)

    def x(self, y):
        """Return the distance from the mid-plane, m, of points at heights y, (streamline, point)."""
        return self.xi[:, None] * self.outer(y)

    def slope(self, y):
        """Return X'(y)."""
        return y * (2 * self.b + 3 * self.c * y)

    def roll_surface(self, y):
        """Return the distance of the roll surface from the mid-plane at height y, m."""
        return self.half_gap + y * y / (self.radius + np.sqrt(self.radius**2 - y * y))

    def deviation(self) -> float:
        """Return how far the outermost streamline leaves the roll surface at most, m."""
        y = self.height * _HEIGHTS
        return float(np.max(np.abs(self.outer(y) - self.roll_surface(y))))


def centres(streamlines: int) -> np.ndarray:
    """Return the labels xi of the middles of equal stream tubes."""
    return (np.arange(streamlines) + 0.5) / streamlines


def between_rolls(diameter: float, gap: float, entry_gap: float, xi: np.ndarray) -> Geometry:
    """Return the bed between two rolls, lengths in m, with the streamlines `xi`.

    The outermost streamline meets the roll in value and slope at y = 0 and y = H (model page, section Geometry).
    """
    radius, rise = diameter / 2, (entry_gap - gap) / 2
    height = math.sqrt(rise * (2 * radius - rise))  # of R^2 - (R - rise)^2, without its cancellation
    b = c = 0.0
    if height > 0:
        slope = height / (radius - rise)
        # products, not powers: lengths times a power of two then give the same bits times theirs
        b = (3 * rise - slope * height) / (height * height)
        c = (slope * height - 2 * rise) / (height * height * height)
    return Geometry(gap / 2, height, b, c, radius, xi)
