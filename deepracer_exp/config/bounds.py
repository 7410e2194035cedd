"""Number types with bounds, so that a dataclass states what its YAML may hold."""

from typing import Annotated

from pydantic import Field

Divisor = Annotated[float, Field(ge=1e-6, le=1e6)]
"""A divisor of quantities in SI units; the quotient stays finite in float32."""
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
# Larger numbers are typing errors.
Count = Annotated[int, Field(ge=1, le=10**12)]
"""A whole number of at least one."""
Natural = Annotated[int, Field(ge=0, le=10**12)]
"""A whole number of at least zero."""
UpTo100 = Annotated[int, Field(ge=1, le=100)]
UpTo1000 = Annotated[int, Field(ge=1, le=1000)]
FEWEST_ACTIONS, MOST_ACTIONS = 6, 100
"""Length of an action list made from laps: at most five actions are added for recovery."""
ActionCount = Annotated[int, Field(ge=FEWEST_ACTIONS, le=MOST_ACTIONS)]
Seconds = Annotated[float, Field(gt=0, le=7 * 86400, allow_inf_nan=False)]
"""A waiting time, up to a week."""
