"""Pushes on the trunk: an impulse spread evenly over a short time, world frame."""

from kjax.config import PushConfig


def impulses(config: PushConfig) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Forward and lateral impulse of every push [N s]."""
    count = len(config.times)

    def each(value: float | tuple[float, ...]) -> tuple[float, ...]:
        return value if isinstance(value, tuple) else (value,) * count

    return each(config.forward), each(config.lateral)
