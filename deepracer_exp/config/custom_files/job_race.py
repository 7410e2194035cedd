"""The boxes and bots of run.env and training_params.yaml as overrides of the group `race`."""

import re
from collections.abc import Mapping
from dataclasses import replace

from pydantic import TypeAdapter

from deepracer_exp.aws.models.job_settings import H2B_KEYS, OA_KEYS, JobSettings
from deepracer_exp.config.overrides import first_given, override_line
from deepracer_exp.config.racing import ALONE, BotsConfig, BoxPosition, RaceConfig
from deepracer_exp.errors import BadInput

ENV_DEFAULTS = {
    "NUMBER_OF_OBSTACLES": "6",
    "RANDOMIZE_OBSTACLE_LOCATIONS": "True",
    "NUMBER_OF_BOT_CARS": "0",
}
"""deepracer-for-cloud's, where they are not the service's (scripts/training/prepare-config.py)."""
_DEFAULTS = {
    "NUMBER_OF_OBSTACLES": "0",
    "MIN_DISTANCE_BETWEEN_OBSTACLES": "2.0",
    "RANDOMIZE_OBSTACLE_LOCATIONS": "False",
    "IS_OBSTACLE_BOT_CAR": "False",
    "OBSTACLE_TYPE": "box_obstacle",
    "OBJECT_POSITIONS": "",
    "NUMBER_OF_BOT_CARS": "0",
    "MIN_DISTANCE_BETWEEN_BOT_CARS": "2.0",
    "RANDOMIZE_BOT_CAR_LOCATIONS": "False",
    "BOT_CAR_SPEED": "0.2",
    "IS_LANE_CHANGE": "False",
    "LOWER_LANE_CHANGE_TIME": "3.0",
    "UPPER_LANE_CHANGE_TIME": "5.0",
    "LANE_CHANGE_DISTANCE": "1.0",
    "PENALTY_SECONDS": "2.0",
}
"""The service's (deepracer-simapp, markov/agent_ctrl/obstacles_agent_ctrl.py and bot_cars_agent_ctrl.py)."""
_LANES = {"1": "inner", "-1": "outer"}
_TRUE = ("true", "t", "yes", "y", "on", "1")
_POSITIONS = TypeAdapter(list[BoxPosition])
_BOTS = TypeAdapter(BotsConfig)
_SEES = "observation.next_objects"
_AS_PER_CENT = (
    "the service takes the distance between boxes for per cent of the lap, and again of its own result; "
    "race.quirks=service does the same"
)


def race_overrides(job: JobSettings, typed: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """Turn the boxes and bots of a training into overrides.

    deepracer-for-cloud reads the keys about boxes for DR_RACE_TYPE=OBJECT_AVOIDANCE only, those about bots for
    HEAD_TO_BOT only; in training_params.yaml numbers decide, whatever the type.

    Args:
        job: of the first simulation worker.
        typed: the user's own overrides by key or group, which have priority.

    Returns:
        The overrides, and a line for each part that is not used or not as it is there, with the reason.

    Raises:
        BadInput: a value is none that the service accepts.
    """
    values = _Values(job.file, job.race, job.race_type if job.is_env else None)
    lines: list[str] = []
    notes: list[str] = []
    chosen: dict[str, object] = {}
    if values.has_boxes:
        chosen |= _boxes(values)
        if "race.boxes.min_distance_m" in chosen:
            notes.append(f"{values.key('MIN_DISTANCE_BETWEEN_OBSTACLES')}: used in metres: {_AS_PER_CENT}")
        if values.truth("IS_OBSTACLE_BOT_CAR"):
            notes.append(f"{values.key('IS_OBSTACLE_BOT_CAR')}=True: not applied: here boxes stand there")
        kind = values.text("OBSTACLE_TYPE")
        if kind != _DEFAULTS["OBSTACLE_TYPE"]:
            notes.append(
                f"{values.key('OBSTACLE_TYPE')}={kind[:80]}: not applied: every box looks like box_obstacle; the "
                "service's crashes do not depend on it"
            )
    if values.has_bots:
        chosen |= _bots(values)
    if not chosen:
        return lines, notes
    for target, value in chosen.items():
        if (winner := first_given(typed, "race", target)) is None:
            lines.append(override_line(target, value))
        else:
            notes.append(f"{target}: not used, because of {winner}")
    if lines and first_given(typed, "observation", _SEES) is None:
        lines.append(override_line(_SEES, 2))
    return lines, notes


def recorded_race(values: Mapping[str, str]) -> RaceConfig | None:
    """Return the boxes and bots of a recording if its parameters determine their places.

    They do for boxes at given positions, and for bots that begin at the same places in every episode and stay in their
    lanes; the distance by which the service spreads other boxes depends on its version.

    Args:
        values: of training_params.yaml, `aws.models.job_settings.race_values`.

    Returns:
        None: the car is alone on the road, or where the others are is not known.

    Raises:
        BadInput: a value is none that the service accepts.
    """
    job = _Values("training_params.yaml", values)
    boxes, bots = ALONE.boxes, ALONE.bots
    if job.text("OBJECT_POSITIONS"):
        positions = tuple(_POSITIONS.validate_python(job.positions()))
        boxes = replace(boxes, placement="fixed", positions=positions)
    if job.has_bots and not job.truth("RANDOMIZE_BOT_CAR_LOCATIONS") and not job.truth("IS_LANE_CHANGE"):
        chosen = {key.removeprefix("race.bots."): value for key, value in _bots(job).items()}
        bots = _BOTS.validate_python(chosen)
    race = replace(ALONE, boxes=boxes, bots=bots)
    return race if race.others else None


class _Values:
    """The values of a job about boxes and bots, by the keys of training_params.yaml."""

    def __init__(self, file: str, race: Mapping[str, str], race_type: str | None = None):
        """Take the values of a file; `race_type` is that of deepracer-for-cloud, None: the file is the service's."""
        self._file, self._race, self._type = file, race, race_type
        self._defaults = _DEFAULTS | (ENV_DEFAULTS if race_type is not None else {})

    @property
    def has_boxes(self) -> bool:
        """Return whether there are any boxes."""
        if self._type not in (None, "OBJECT_AVOIDANCE"):
            return False
        return bool(self.text("OBJECT_POSITIONS")) or self.number("NUMBER_OF_OBSTACLES") > 0

    @property
    def has_bots(self) -> bool:
        """Return whether there are any bots."""
        if self._type not in (None, "HEAD_TO_BOT"):
            return False
        return self.number("NUMBER_OF_BOT_CARS") > 0

    def key(self, name: str) -> str:
        """Return the file's name of a key."""
        return (OA_KEYS | H2B_KEYS)[name] if self._type is not None else name

    def text(self, name: str) -> str:
        """Return a value as text."""
        return self._race.get(name, self._defaults[name])

    def truth(self, name: str) -> bool:
        """Return a value that is true or false, as the service reads it."""
        return self.text(name).lower() in _TRUE

    def number(self, name: str) -> float:
        """Return a number.

        Raises:
            BadInput: it is none, or below 0.
        """
        text = self.text(name)
        try:
            number = float(text)
        except ValueError:
            number = -1.0
        if not 0 <= number < 1e6:
            raise BadInput(self._file, f"{self.key(name)}={text[:80]}", "a number from 0 up")
        return number

    def positions(self) -> list[dict[str, object]]:
        """Return the places of boxes, as `race.boxes.positions`.

        Raises:
            BadInput: they are none that the service reads.
        """
        text = self.text("OBJECT_POSITIONS")
        places = []
        for part in filter(None, (piece.strip() for piece in text.split(";"))):
            match = re.fullmatch(r"([0-9.]+)\s*,\s*(-?1)(?:\.0*)?", part)
            share = float(match[1]) if match and match[1].count(".") < 2 and match[1] != "." else 2.0
            if match is None or share > 1:
                accepted = "share of the lap and lane, 1 inner or -1 outer: 0.25,1;0.5,-1"
                raise BadInput(self._file, f"{self.key('OBJECT_POSITIONS')}={text[:80]}", accepted)
            # A box at the end of the lap is one at its beginning.
            places.append({"lap": share % 1.0, "lane": _LANES[match[2]]})
        return places


def _boxes(values: _Values) -> dict[str, object]:
    if values.text("OBJECT_POSITIONS"):
        return {"race.boxes.placement": "fixed", "race.boxes.positions": values.positions()}
    random = values.truth("RANDOMIZE_OBSTACLE_LOCATIONS")
    return {
        "race.boxes.number": int(values.number("NUMBER_OF_OBSTACLES")),
        "race.boxes.placement": "random" if random else "alternating",
        "race.boxes.min_distance_m": values.number("MIN_DISTANCE_BETWEEN_OBSTACLES"),
    }


def _bots(values: _Values) -> dict[str, object]:
    after_s = [values.number(f"{end}_LANE_CHANGE_TIME") for end in ("LOWER", "UPPER")]
    return {
        "race.bots.number": int(values.number("NUMBER_OF_BOT_CARS")),
        "race.bots.placement": "random" if values.truth("RANDOMIZE_BOT_CAR_LOCATIONS") else "alternating",
        "race.bots.min_distance_m": values.number("MIN_DISTANCE_BETWEEN_BOT_CARS"),
        "race.bots.speed_mps": values.number("BOT_CAR_SPEED"),
        "race.bots.lane_change_after_s": after_s if values.truth("IS_LANE_CHANGE") else None,
        "race.bots.lane_change_distance_m": values.number("LANE_CHANGE_DISTANCE"),
        "race.bots.pause_s": values.number("PENALTY_SECONDS"),
    }
