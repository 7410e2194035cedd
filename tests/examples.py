"""How many examples Hypothesis draws."""

from typing import Any

from hypothesis import settings


def examples(count: int, **more: Any) -> settings:
    """Let a test draw as many new examples in `make test-long`, and otherwise a third of them, always the same."""
    drawn = count if settings.get_current_profile_name() == "new" else -(-count // 3)
    return settings(max_examples=drawn, **more)
