"""The race (`conf/race/`): alone, among boxes, bots or both, as numbers decide on the service, or with a rival."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from .bounds import NonNegative, Positive
from .driving import Range

Number = Annotated[int, Field(ge=0, le=20)]
Share = Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)]
BotSpeed = Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]

LANES = ("inner", "outer")
"""Names of the lanes; the position is the lane's number."""


@dataclass(frozen=True, kw_only=True)
class BoxPosition:
    """The place of a box."""

    lap: Share
    lane: Literal["inner", "outer"]


@dataclass(frozen=True, kw_only=True)
class BoxesConfig:
    """Boxes on the road."""

    number: Number
    placement: Literal["random", "alternating", "fixed"]
    positions: Annotated[tuple[BoxPosition, ...], Field(max_length=20)]
    min_distance_m: NonNegative

    def __post_init__(self) -> None:
        """Refuse positions without the placement that uses them, and the placement without positions."""
        if self.positions and self.placement != "fixed":
            raise ValueError(
                f"positions are used by placement=fixed only, and placement={self.placement}; accepted: "
                "placement=fixed, or positions=[]"
            )
        if self.placement == "fixed" and not self.positions:
            raise ValueError(
                "placement=fixed without positions; accepted: positions=[{lap: 0.25, lane: inner}]"
            )

    @property
    def count(self) -> int:
        """Return the number of boxes."""
        return len(self.positions) if self.placement == "fixed" else self.number


@dataclass(frozen=True, kw_only=True)
class BotsConfig:
    """Cars of the service's that follow the lanes at a constant speed."""

    number: Number
    placement: Literal["random", "alternating"]
    min_distance_m: NonNegative
    speed_mps: BotSpeed
    lane_change_after_s: Range[NonNegative] | None
    lane_change_distance_m: Positive
    pause_s: NonNegative

    @property
    def count(self) -> int:
        """Return the number of bots."""
        return self.number


NEWEST, POOL = "newest", "pool"
"""Rivals that a run makes itself; any other `RivalsConfig.policy` names a run."""


@dataclass(frozen=True, kw_only=True)
class RivalsConfig:
    """Another car beside every learner, driven by a policy that does not learn."""

    policy: Annotated[str, Field(min_length=1)]
    checkpoint: Annotated[str, Field(min_length=1)] | None
    snapshot_every: Annotated[int, Field(ge=1, le=10**6)]
    pool_size: Annotated[int, Field(ge=1, le=100)]
    pace: Range[Annotated[float, Field(ge=0.3, le=1, allow_inf_nan=False)]]
    start_gap_m: Annotated[float, Field(ge=0.4, le=5, allow_inf_nan=False)]
    pause_s: NonNegative

    def __post_init__(self) -> None:
        """Refuse a checkpoint of the learner's own snapshots."""
        if self.is_own and self.checkpoint is not None:
            raise ValueError(
                f"checkpoint={self.checkpoint}: policy={self.policy} takes the learner's own snapshots; accepted: "
                "checkpoint=null, or policy=RUN"
            )

    @property
    def is_own(self) -> bool:
        """Return whether the rivals are snapshots of the learner."""
        return self.policy in (NEWEST, POOL)


@dataclass(frozen=True, kw_only=True)
class RaceConfig:
    """The other cars and boxes on the track."""

    boxes: BoxesConfig
    bots: BotsConfig
    quirks: Literal["fixed", "service"]
    rivals: RivalsConfig | None = None

    def __post_init__(self) -> None:
        """Refuse bots beside a rival: once one car stops them, the two cars would meet them at different places."""
        if self.rivals is not None and self.bots.count:
            raise ValueError(
                f"rivals: race without bots, and there are {self.bots.count}; accepted: bots.number=0, or rivals=null"
            )

    @property
    def others(self) -> int:
        """Return the number of boxes, bots and rivals around a car."""
        return self.boxes.count + self.bots.count + (self.rivals is not None)


ALONE = RaceConfig(
    boxes=BoxesConfig(number=0, placement="random", positions=(), min_distance_m=2.0),
    bots=BotsConfig(
        number=0,
        placement="alternating",
        min_distance_m=2.0,
        speed_mps=0.75,
        lane_change_after_s=None,
        lane_change_distance_m=1.0,
        pause_s=2.0,
    ),
    quirks="fixed",
)
"""The race of runs stored before races had boxes, bots or rivals."""
