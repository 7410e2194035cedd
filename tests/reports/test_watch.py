"""Films of what a policy sees, and the page that follows a training."""

import http.client
import io
import itertools
import json
import re
import shutil
import socket
import struct
import threading
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import shapely
import torch
from filelock import FileLock
from imageio_ffmpeg import read_frames
from rich.console import Console
from tensordict import TensorDict

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.driving import CameraConfig
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.errors import BadInput
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.film import Lap, LapRecorder, drive_best_lap, in_frames, write_film
from deepracer_exp.reports.pages import live_page as live
from deepracer_exp.reports.pages.live_page import LivePage, track_lines
from deepracer_exp.reports.pages.live_server import LiveServer
from deepracer_exp.reports.pages.sight import picture_of, saliency
from deepracer_exp.reports.pages.watch import HEIGHT, WIDTH, Frames, rays
from deepracer_exp.runs.run_files import read_metrics
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.sim.lidar_rays import MOUNT_X_M
from deepracer_exp.sim.scenery import wall_ring
from deepracer_exp.tracks.track import Track
from tests.browser import needs_chromium
from tests.page_html import Html
from tests.waiting import wait_until

STEREO = CameraConfig(width=80, height=60, color="rgb", frames=2, stereo_m=0.06, field_of_view_deg=65)
MONO = CameraConfig(width=80, height=60, color="grey", frames=2, stereo_m=0, field_of_view_deg=65)


class Reader(torch.nn.Module):
    """Decides by the contrast of some pixels alone."""

    def __init__(self, *where: slice | int) -> None:
        super().__init__()
        self._where = (..., *where)

    def forward(self, seen: TensorDict) -> TensorDict:
        read = seen["pixels"].float()[self._where].flatten(1).std(1) / 255
        logits = torch.stack([10 * read, torch.zeros_like(read)], -1)
        return seen.set("logits", logits).set("action", logits.argmax(-1))


def step(camera: CameraConfig, policy: torch.nn.Module) -> TensorDict:
    """One step in which noise was seen."""
    pixels = torch.randint(
        0, 256, (1, *camera.shape), dtype=torch.uint8, generator=torch.Generator().manual_seed(1)
    )
    return policy(TensorDict({"pixels": pixels}, [1]))[0]


def driven(experiment: Experiment, config: EvaluationConfig) -> tuple[torch.nn.Module, Lap, TensorDict]:
    """Return a new policy and its best lap."""
    evaluator = Evaluator(experiment, config, threads=1)
    observed, actions = observation_shape(experiment.observation), evaluator.race.setup.actions
    generator = torch.Generator().manual_seed(0)
    policy = build_actor_critic(experiment.network, observed, actions.n, generator).policy
    return policy, *drive_best_lap(evaluator, policy)


@pytest.mark.parametrize("frame", [0, 1])
def test_a_network_that_reads_the_left_half_of_any_picture_looks_there(frame):
    policy = Reader(frame, slice(None), slice(0, 40))
    heat = saliency(policy, step(MONO, policy), MONO)
    assert heat.shape == (60, 80)
    assert heat[:, :40].max() == 1
    assert heat[:, 54:].max() < 0.01
    other = Reader(frame, slice(None), slice(40, 80))
    assert saliency(other, step(MONO, other), MONO)[:, :26].max() < 0.01


def test_of_a_picture_much_wider_than_high_some_place_counts_most():
    camera = replace(MONO, width=640, height=16)
    policy = Reader(1, slice(None), slice(None))
    heat = saliency(policy, step(camera, policy), camera)
    assert heat.shape == (16, 640)
    assert heat.max() == 1


def test_a_network_that_reads_one_of_two_cameras_looks_through_that_alone():
    policy = Reader([3, 4, 5, 9, 10, 11], slice(None), slice(None))
    heat = saliency(policy, step(STEREO, policy), STEREO)
    assert picture_of(step(STEREO, policy), STEREO).size == (160, 60) == heat.shape[::-1]
    assert heat[:, 80:].max() == 1
    assert heat[:, :80].max() == 0


@pytest.mark.parametrize(
    "overrides",
    [
        ("observation=camera_small",),
        ("action_space=continuous",),
        ("observation=lidar", "observation.lidar.kind=discretized", "observation.lidar.reach_m=12"),
        ("observation=camera_lidar",),
    ],
    ids=["pictures", "continuous", "lidar", "pictures and lidar"],
)
def test_a_film_has_thirty_frames_a_second_and_shows_another_picture_in_each(circle, protocol, overrides):
    experiment = compose_experiment([f"track.file={circle}", *overrides])[0]
    policy, lap, acted = driven(experiment, protocol("three_trials", trials=2, time_s=0.4))
    assert len(lap) == len(acted) == 6  # the prepare step, a step after the reset, and five more
    actions = build_action_space(experiment.action_space)
    frames = list(Frames(lap, acted, policy, actions, experiment.observation, experiment.car))
    assert len(frames) == 11  # two for each of the first five rows at 15 Hz, and the last
    assert {frame.shape for frame in frames} == {(HEIGHT, WIDTH, 3)}
    assert all((one != other).any() for one, other in itertools.pairwise(frames))
    if experiment.observation.camera is not None:
        enlarged = 480 // experiment.observation.camera.width
        shown = frames[9][0:360:enlarged, 0:480:enlarged]
        assert (shown[20:] == acted["pixels"][4, 0].numpy()[20:, :, None]).all(), (
            "smoothed, or of another step"
        )


@pytest.mark.parametrize(
    ("race", "rgb"), [("object_avoidance", (123, 97, 79)), ("head_to_bot", (152, 161, 172))]
)
def test_a_film_shows_boxes_and_bots_from_above_where_they_are(circle, protocol, race, rgb):
    asked = (f"race={race}", "race.bots.min_distance_m=1", "observation.next_objects=2")
    experiment = compose_experiment([f"track.file={circle}", *asked])[0]
    policy, lap, acted = driven(experiment, protocol("three_trials", trials=2, time_s=0.6))
    assert lap.others.shape[1] == experiment.race.others
    actions = build_action_space(experiment.action_space)
    first, *_, last = Frames(lap, acted, policy, actions, experiment.observation, experiment.car)
    brightest = np.abs(first.astype(int) - rgb).max(axis=2) < 25
    assert brightest.sum() > 20 * experiment.race.others
    moved = (first != last).any(axis=2) & brightest
    assert bool(moved[100:500].sum() > 100) is (race == "head_to_bot"), "boxes stand and bots drive"


def test_a_lap_has_the_boxes_of_its_own_trial_and_bots_drive_on_between_its_steps(protocol):
    on = ("track=reInvent2019_track", "race=head_to_bot", "race.boxes.number=2", "observation.next_objects=2")
    experiment = compose_experiment(on)[0]
    evaluator = Evaluator(experiment, protocol("three_trials", trials=3, time_s=1), threads=1)
    placed = []
    recorder = LapRecorder(evaluator)

    def record(race, *more):
        placed.append(race.others.others.poses.copy())
        recorder(race, *more)

    observed = observation_shape(experiment.observation)
    policy = build_actor_critic(
        experiment.network, observed, evaluator.race.setup.actions.n, torch.Generator().manual_seed(0)
    ).policy
    attempt = evaluator(policy, record).groups[0].attempts[-1]
    lap = recorder.lap(attempt)
    expected = np.array(placed)[: len(lap), attempt.trial]
    np.testing.assert_allclose(lap.others[..., :2], expected[..., :2], atol=1e-5)
    assert len(lap.boxes) == 2
    shown, _ = in_frames(lap, 15)
    bots = shown.others[:, 2:, :2]
    away_m = np.linalg.norm(np.diff(bots, axis=0), axis=2)[2 * 3 :]
    assert (away_m > 0.5 * 0.75 / 30).all(), "a bot stands in a frame"


@pytest.mark.parametrize("yaw_deg", [0, 180])
def test_the_rays_of_a_film_end_at_the_walls(protocol, yaw_deg):
    own = (f"observation.lidar.{one}" for one in ("noise_m=0", "reach_m=12", f"yaw_deg={yaw_deg}"))
    experiment = compose_experiment(["observation=lidar", *own])[0]
    lidar, front_m = experiment.observation.lidar, experiment.car.front_point_m
    _, lap, acted = driven(experiment, protocol("three_trials", trials=1, time_s=1))
    sensor, ends = np.split(rays(lap, acted["lidar"].numpy(), lidar, front_m), [1], axis=1)
    wall = shapely.LineString(wall_ring(lap.track))
    assert shapely.distance(wall, shapely.points(ends)) == pytest.approx(0, abs=1e-3)
    front = np.array([lap.x_m[0], lap.y_m[0]])
    assert np.linalg.norm(sensor[0, 0] - front) == pytest.approx(front_m - MOUNT_X_M)


@pytest.mark.processes
def test_a_written_film_shows_its_last_frame_for_a_second(tmp_path):
    frames = [np.full((32, 48, 3), 20 * at, np.uint8) for at in range(10)]
    write_film(tmp_path / "lap.mp4", frames, len(frames), (48, 32), Console(file=io.StringIO()))

    def read() -> list:
        with suppress(OSError):  # the program's start may take longer than the library waits
            return list(read_frames(str(tmp_path / "lap.mp4")))
        return []

    about, *written = wait_until(read)
    assert (about["fps"], about["size"]) == (30, (48, 32))
    assert len(written) == 10 + 30
    shades = [np.frombuffer(one, np.uint8).mean() for one in written]
    assert np.abs(np.array(shades) - [20 * min(at, 9) for at in range(40)]).max() < 6


@pytest.mark.parametrize("penalty_s", [2, 0])
@pytest.mark.parametrize(("control_hz", "frames"), [(15, 9), (30, 5), (20, 7), (60, 3)])
def test_between_steps_a_filmed_car_drives_on_but_not_where_it_was_put_back(
    circle, control_hz, frames, penalty_s
):
    x_m = np.array([0.0, 0.1, 0.2, 5.0, 5.1])
    time_s = np.arange(5) / control_hz + penalty_s * np.array([0, 0, 0, 1, 1])
    nothing, yaw_rad = np.zeros(5), np.array([3.1, -3.1, -3.0, 0.0, 0.1])
    lap = Lap(None, Track.from_file(circle), "", x_m, nothing, yaw_rad, nothing, nothing, 10 * x_m, time_s)
    shown, step = in_frames(lap, control_hz)
    assert len(shown) == len(step) == frames
    assert (shown.x_m[-1], shown.time_s[-1]) == (5.1, time_s[-1])
    assert not ((shown.x_m > 0.2 + 1e-9) & (shown.x_m < 5.0)).any()
    assert np.diff(shown.time_s).min() > -1e-9
    # Through the back of the circle, not around its front.
    assert np.abs(np.diff(shown.yaw_rad[step < 2])).max(initial=0) < 0.2
    if control_hz == 15:
        assert shown.x_m[:4] == pytest.approx([0.0, 0.05, 0.1, 0.15])


def test_a_car_that_is_put_back_among_others_does_not_drive_there(circle):
    x_m, nothing = np.array([0.0, 0.1, 3.0, 3.0, 3.0]), np.zeros(5)
    held = np.array([False, False, True, True, False])
    others = np.zeros((5, 1, 9))
    others[:, 0, 0] = [0.0, 0.05, 0.1, 0.15, 0.2]
    time_s = np.arange(5) / 15
    lap = Lap(
        *(None, Track.from_file(circle), "", x_m, nothing, nothing, nothing, nothing, nothing, time_s),
        others=others,
        held=held,
    )
    shown, _ = in_frames(lap, 15)
    assert not ((shown.x_m > 0.1 + 1e-9) & (shown.x_m < 3.0)).any()
    assert shown.others[:, 0, 0] == pytest.approx(0.025 * np.arange(9))
    assert shown.held.tolist() == [False] * 4 + [True] * 4 + [False]


def half(*_: object) -> tuple[str, float]:
    """Half of the budget is used."""
    return "env_steps", 0.5


def test_the_live_page_changes_when_there_is_a_newer_checkpoint(run_dir, protocol):
    run = StoredRun(run_dir)
    page = LivePage(run, protocol("three_trials", trials=2, time_s=1), half)
    first = page.shown
    assert "its laps are being driven" in first[1]
    assert page.update()
    second = page.shown
    assert page.update() is False, "drawn again for nothing"
    newest = (run.checkpoints / "last").resolve()
    assert f"checkpoint {int(newest.name)}" in second[1]
    before = {path.relative_to(run.path) for path in run.path.rglob("*")}
    newer = run.checkpoints / "999999"
    shutil.copytree(newest, newer)
    (run.checkpoints / "last").unlink()
    (run.checkpoints / "last").symlink_to(newer.name)
    assert page.update()
    assert "checkpoint 999999" in page.shown[1]
    assert len({version for version, _ in (first, second, page.shown)}) == 3
    after = {path.relative_to(run.path) for path in run.path.rglob("*")}
    assert {path for path in after - before if path.parts[:2] != ("checkpoints", "999999")} == set()


@pytest.mark.processes
def test_the_live_page_tells_a_running_training_from_one_that_was_killed_or_has_ended(
    run_dir, protocol, monkeypatch
):
    (run_dir / "summary.json").rename(run_dir / "kept.json")
    monkeypatch.setattr(live, "_CURVES_EVERY_S", 0.0)
    with FileLock(run_dir / ".running"):
        page = LivePage(StoredRun(run_dir), protocol("three_trials", trials=1, time_s=0.5), half)
        shown = Html(page.shown[1])
        assert "tiny: running" in shown.text
        assert "50% of the budget · iteration 4 · 4,096 steps" in shown.text
        assert shown.ids.index("figure-curves_so_far") < shown.ids.index("laps")
        page.update()
        row = read_metrics(run_dir / "metrics.jsonl")[-1]
        with (run_dir / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(row | {"iteration": 5, "env_steps": 5120}) + "\n")
        assert page.update(), "a new iteration changes the curves"
        assert "iteration 5 · 5,120 steps" in Html(page.shown[1]).text
    assert page.update()
    assert "tiny: killed" in Html(page.shown[1]).text
    (run_dir / "kept.json").rename(run_dir / "summary.json")
    assert page.update()
    assert "tiny: finished: budget reached: env_steps" in Html(page.shown[1]).text


@needs_chromium
def test_the_clock_of_the_live_page_goes_on_and_its_curves_are_above_the_fold(
    run_dir, protocol, tab, tmp_path
):
    (run_dir / "summary.json").unlink()
    with FileLock(run_dir / ".running"):
        page = LivePage(StoredRun(run_dir), protocol("three_trials", trials=1, time_s=0.5), half)
    file = tmp_path / "live.html"
    file.write_text(page.shown[1], encoding="utf-8")
    tab.open(file, height=900)
    elapsed, left = (f"document.querySelector('.clock .{name}').textContent" for name in ("elapsed", "left"))
    assert re.fullmatch(r"\d+:\d\d", tab.evaluate(left))
    shown = tab.evaluate(elapsed)
    tab.wait_for(f"{elapsed} !== {json.dumps(shown)}")
    box = "document.querySelector('[data-plot=curves_so_far]')"
    tab.wait_for(f"{box}.dataset.state === 'drawn'")
    assert tab.evaluate(f"{box}.getBoundingClientRect().bottom") < 900


def test_a_lap_that_the_end_of_the_race_cuts_off_is_drawn_but_not_counted(experiment, protocol, driver):
    evaluator = Evaluator(experiment, protocol("four_minutes", trials=1, time_s=18.0), threads=1)
    recorder = LapRecorder(evaluator)
    evaluation = evaluator(driver(), recorder)
    *complete, last = evaluation.groups[0].attempts
    assert last.end == "time_up"
    (shown,) = track_lines(evaluator, evaluation, recorder)
    assert shown.words.startswith(f"{len(complete)} of {len(complete)} usual laps complete, the fastest in ")
    assert len(shown.lines) == len(complete) + 1


def test_the_live_page_is_served_to_this_machine_alone():
    with LiveServer(0) as server:
        server.shown = ("7", "<p>laps</p>")
        threading.Thread(target=server.serve_forever, daemon=True).start()
        assert server.server_address[0] == "127.0.0.1"

        def get(path: str, **headers: str) -> tuple[int, str]:
            asked = http.client.HTTPConnection(*server.server_address)
            asked.request("GET", path, headers=headers)
            answer = asked.getresponse()
            return answer.status, answer.read().decode()

        assert [get("/"), get("/version")] == [(200, "<p>laps</p>"), (200, "7")]
        assert get("/../config.yaml")[0] == 404
        for name in ("localhost", "127.0.0.1:80", "[::1]:9000"):  # through a tunnel
            assert get("/version", Host=name) == (200, "7")
        for name in (
            "",
            "evil.example",
            "evil.example:80",
            "localhost.evil.example",
            "127.0.0.1.evil.example",
        ):
            status, said = get("/", Host=name)
            assert (status, "laps" in said) == (421, False), name
        with pytest.raises(BadInput, match=f"--port {server.server_port}: .*in use"):
            LiveServer(server.server_port)
        server.shutdown()


def test_a_browser_that_leaves_before_it_has_the_page_is_no_error(capfd):
    with LiveServer(0) as server:
        server.shown = ("1", "laps " * 2_000_000)
        with socket.create_connection(server.server_address) as browser:
            browser.sendall(b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n")
            browser.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # reset at once
        server.process_request_thread(*server.get_request())
    assert capfd.readouterr().err == ""


@pytest.mark.processes
def test_the_film_is_put_into_the_folder_of_the_run(run_dir, call):
    ended = call("watch", str(run_dir), "evaluation.trials=1", "evaluation.time_s=0.6")
    assert ended.code == 0, ended.stderr
    (film,) = run_dir.glob("films/*.mp4")
    assert film.stem == (run_dir / "checkpoints" / "best").resolve().name
    assert film.name in ended.stdout


def test_the_laps_of_two_runs_drive_beside_each_other(run_dir, call):
    other = shutil.copytree(run_dir, run_dir.parent / "another", symlinks=True)
    quick = ("evaluation.trials=2", "evaluation.time_s=2")
    for arguments in (
        ("watch", str(run_dir), str(other), "--replay", "laps.html", *quick),
        ("compare", str(run_dir), str(other), "--replay", "compared.html"),
    ):
        ended = call(*arguments)
        assert ended.code == 0, ended.stderr
        page = ended.cwd / next(word for word in arguments if word.endswith(".html"))
        text = Html(page.read_text(encoding="utf-8")).text
        assert f"A {run_dir.name} the f" in text
        assert "B another the f" in text
        assert page.name in ended.stdout
    call("watch", str(run_dir), "--replay", "laps.mp4").assert_refused("--replay laps.mp4", ".html")
    call("watch", str(run_dir), "--live", "--replay", "laps.html").assert_refused("without --live")
