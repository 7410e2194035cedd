"""The page of a physical car's drive, and what a policy of ours would have done on its pictures."""

import io
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from tensordict import TensorDict

from deepracer_exp.analysis.car_drive import (
    Decisions,
    action_names,
    differences,
    headline,
    sentences,
    side,
    spell_table,
    spells,
)
from deepracer_exp.analysis.charts.car_drive import drive_charts
from deepracer_exp.aws.logs.car_log import CarLog
from deepracer_exp.aws.models.car_controls import full_scale, steering_share, throttle
from deepracer_exp.env.action_space import build_action_space, metadata_of
from deepracer_exp.env.real_car import CAR_PICTURE, FRAME_SCALE, UNCOMPRESSED, car_pictures, check_car
from deepracer_exp.errors import BadInput, reading
from deepracer_exp.evaluation.film import png
from deepracer_exp.files import atomic_write
from deepracer_exp.lookup.resolve import StoredRun

from .page import Glimpse, plot_of, png_uri, render
from .picture_changes import decide, spread_out
from .sight import picture_of, saliency, under_heat

_AT_ONCE = 256
"""Pictures that are unpacked at once."""
_GLIMPSES = 8
_APART_S = 0.5
"""Time between two pictures on which a policy decides most differently: neighbours look alike."""
_ENLARGED = 240


class DrivenPolicy:
    """A policy of ours that decides on the pictures of a drive."""

    def __init__(self, run: StoredRun) -> None:
        """Read the run's chosen checkpoint.

        Raises:
            BadInput: it cannot be read, or the car could not show the policy what it needs.
        """
        experiment = run.experiment
        check_car(experiment)
        if experiment.observation.lidar is not None:
            raise BadInput(run.path.name, "sees with a LIDAR, which the car's log has not", "a camera alone")
        assert experiment.observation.camera is not None
        self.name = experiment.name
        self.camera = experiment.observation.camera
        self.actions = build_action_space(experiment.action_space)
        self.networks = run.read_policy().networks.policy

    def see(self, log: CarLog, rows: NDArray[np.intp]) -> TensorDict:
        """Return what the policy reads and writes on some pictures, [n].

        Raises:
            BadInput: a picture is corrupt, or the log has not as many for each decision as the policy reads.
        """
        pixels = np.stack([grey_pictures(log, row) for row in rows.tolist()])
        if pixels.shape[1] != self.camera.shape[0]:
            raise BadInput(
                log.name,
                f"has {pixels.shape[1]} pictures for each decision",
                f"{self.camera.shape[0]}, which {self.name} reads",
            )
        return decide(self.networks, TensorDict({"pixels": torch.from_numpy(pixels)}, [len(rows)]))

    def decisions(self, log: CarLog) -> Decisions:
        """Return what the policy would have done on every picture; errors as for `see`."""
        outputs, actions = [], []
        for rows in np.array_split(np.arange(len(log)), -(-len(log) // _AT_ONCE)):
            acted = self.see(log, rows)
            logits = acted.get("logits", None)
            outputs.append((acted["action"] if logits is None else logits.softmax(-1)).numpy())
            actions.append(acted["action"].numpy())
        steering_deg, speed_mps = self.actions.commands(np.concatenate(actions))
        scale = full_scale(metadata_of(self.actions))
        return Decisions(
            self.name,
            np.concatenate(outputs).astype(np.float64),
            steering_share(steering_deg, scale.steering_deg),
            throttle(speed_mps, scale.speed_mps),
        )


def grey_pictures(log: CarLog, row: int) -> NDArray[np.uint8]:
    """Return the pictures of a decision as the car shows them to a model, (1 or 2, height, width).

    Raises:
        BadInput: a picture is corrupt or of another size.
    """
    width, height = CAR_PICTURE
    shown = []
    for content in log.pictures[row]:
        with reading(f"{log.name}: picture {row}", "a JPEG or PNG of the car"):
            picture = Image.open(io.BytesIO(content), formats=("JPEG", "PNG"))
            if picture.size not in ((width, height), (FRAME_SCALE * width, FRAME_SCALE * height)):
                raise BadInput(
                    f"{log.name}: picture {row}",
                    f"is {picture.width}x{picture.height}",
                    f"{width}x{height}, or {FRAME_SCALE * width}x{FRAME_SCALE * height} without camera_resize",
                )
            grey = np.asarray(picture.convert("L"))
        whole = grey.shape == (height, width)
        shown.append(grey if whole else car_pictures(grey[None, None], UNCOMPRESSED)[0, 0])
    return np.stack(shown)


def write_drive_page(path: Path, log: CarLog, policy: DrivenPolicy | None) -> list[str]:
    """Write the page of a drive atomically; return its sentences.

    Raises:
        BadInput: a picture is corrupt.
        OSError: the page cannot be written.
    """
    decisions = None if policy is None else policy.decisions(log)
    lines = sentences(log, decisions)
    charts = drive_charts(log, decisions)
    page = render(
        __package__,
        "car_drive.html.j2",
        [plot_of(chart) for chart in charts],
        title=log.name,
        headline=headline(log),
        sentences=lines,
        problems=log.problems,
        spells=spell_table(log, decisions),
        strip=_glimpses(log, policy, decisions),
        captions={chart.name: chart.caption for chart in charts},
    )
    atomic_write(path, page)
    return lines


def _glimpses(log: CarLog, policy: DrivenPolicy | None, decisions: Decisions | None) -> list[Glimpse]:
    """Return the pictures on which the car hesitates most or a policy decides most differently; else evenly spread."""
    rows = [(spell.first + spell.last) // 2 for spell in spells(log)]
    if decisions is not None:
        apart = np.nan_to_num(np.abs(differences(log, decisions)))
        order = np.argsort(-apart, kind="stable")
        against = spread_out(order[apart[order] > 0], log.time_s, _APART_S, _GLIMPSES // 2)
        rows = [*against, *rows]
    rows += np.linspace(0, len(log) - 1, _GLIMPSES).astype(int).tolist()
    names, strip = action_names(log), []
    for row in sorted(list(dict.fromkeys(rows))[:_GLIMPSES]):
        if policy is None:
            grey = np.concatenate(list(grey_pictures(log, row)), axis=1)
            picture, looked = Image.fromarray(grey), ""
        else:
            acted = policy.see(log, np.array([row]))[0]
            picture = picture_of(acted, policy.camera)
            heat = saliency(policy.networks, acted, policy.camera)
            size = (_ENLARGED * picture.width // policy.camera.width, _ENLARGED * 3 // 4)
            looked = png_uri(png(under_heat(picture, heat, size)))
        action = int(log.outputs[row].argmax())
        did = (
            f"{names[action]} ({log.outputs[row, action]:.0%})"
            if log.is_discrete
            else side(float(log.steering[row]))
        )
        if decisions is not None:
            did += f"; {side(float(decisions.steering[row]))} by the policy"
        strip.append(Glimpse(png_uri(png(picture)), looked, f"{log.time_s[row]:.1f} s", did))
    return strip
