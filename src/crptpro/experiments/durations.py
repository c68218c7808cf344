"""Times in words."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """Say how long something took or will take.

    Examples:
        >>> duration(42.3), duration(600), duration(9000), duration(400_000)
        ('42 s', '10 min', '2.5 h', '4.6 days')
    """
    for unit, size, limit in (("s", 1, 100), ("min", 60, 6_000), ("h", 3_600, 3_600 * 48)):
        if seconds < limit:
            value = seconds / size
            return f"{value:.1f} {unit}" if unit == "h" and value < 10 else f"{value:.0f} {unit}"
    return f"{seconds / 86_400:.1f} days"
