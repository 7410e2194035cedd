"""`trace=full|laps|off`: which steps a run keeps, and what its readers say of the others."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import yaml

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.trace_columns import PACKED_COLUMNS, STATUS_CODE, to_table
from deepracer_exp.errors import BadInput
from deepracer_exp.reports.findings import findings
from deepracer_exp.reports.pages import log_report
from deepracer_exp.reports.pages.log_report import LogPage, draw_sections
from deepracer_exp.reports.tables.log_view import prepare
from deepracer_exp.runs.recording import LAPS_ONLY, read_run_recording
from deepracer_exp.runs.trace import LapWriter, read_trace, rewind_trace

ENDS = {1: (10, "lap_complete"), 2: (7, "off_track"), 3: (25, "lap_complete"), 4: (25, "off_track")}
"""The last step of each episode and how it ends; the fifth never ends."""


def driven(iteration: int, steps_each: int = 8) -> pd.DataFrame:
    """Return the rows of five cars in an iteration, as a packed trace has them."""
    rows = []
    for episode in range(1, 6):
        last, ending = ENDS.get(episode, (10**6, ""))
        for step in range(steps_each * (iteration - 1) + 1, min(steps_each * iteration, last) + 1):
            status = STATUS_CODE[ending] if step == last else STATUS_CODE["in_progress"]
            row = dict.fromkeys(PACKED_COLUMNS, 0.0)
            row |= {"episode": episode, "steps": step, "X": step / 10, "reward": 0.1 * step, "car": episode}
            rows.append(row | {"done": step == last, "episode_status": status})
    return pd.DataFrame(rows, columns=list(PACKED_COLUMNS)).astype(np.float64)


def add(writer: LapWriter, iteration: int) -> None:
    writer.add(iteration, to_table(driven(iteration).to_numpy(), iteration, ["Oval_track"]))


def kept(folder) -> list[tuple[int, int]]:
    trace = read_trace(folder, ["episode", "steps"])
    return list(zip(trace.episode, trace.steps, strict=True))


LAPS = [(1, step) for step in range(1, 11)] + [(3, step) for step in range(1, 26)]


def test_only_the_rows_of_complete_laps_are_kept_from_their_first_step_on(tmp_path):
    writer = LapWriter(tmp_path)
    for iteration in (1, 2, 3, 4):
        add(writer, iteration)
        if iteration % 2 == 0:
            writer.flush()
    assert kept(tmp_path) == LAPS
    assert [path.name for path in sorted(tmp_path.glob("*-iteration.parquet"))] == [
        "00002-iteration.parquet",
        "00004-iteration.parquet",
    ]


@pytest.mark.parametrize("saved", [1, 2, 3])
def test_a_run_that_is_resumed_keeps_the_laps_that_were_under_way(tmp_path, saved):
    before = LapWriter(tmp_path)
    for iteration in range(1, saved + 1):
        add(before, iteration)
    before.flush()
    add(before, saved + 1)
    before.flush()  # and the process is killed before there is a checkpoint of that iteration
    after = LapWriter(tmp_path)
    after.resume(saved)
    rewind_trace(tmp_path, saved)
    for iteration in range(saved + 1, 5):
        add(after, iteration)
    after.flush()
    assert kept(tmp_path) == LAPS
    waiting = [path.name for path in tmp_path.glob("*-open.parquet")]
    assert "00004-open.parquet" in waiting
    assert len(waiting) <= 2


@pytest.mark.parametrize(
    ("value", "word"), [("full", "full"), ("laps", "laps"), ("off", "off"), ("false", "off")]
)
def test_the_steps_to_keep_are_one_of_three_words(value, word):
    experiment, _ = compose_experiment([f"trace={value}"])
    assert experiment.trace == word


def test_another_word_is_refused_with_those_accepted():
    with pytest.raises(BadInput, match=r'trace="some": .*full.*laps.*off'):
        compose_experiment(["trace=some"])


@pytest.mark.parametrize(
    ("kept", "why"), [("off", "it was trained with trace=off"), ("laps", "trace=laps keeps complete laps")]
)
def test_every_reader_says_in_a_line_what_is_missing(trained, call, kept, why):
    run = trained("budget.iterations=1", "report=true", "evaluation.trials=1", f"trace={kept}")
    assert run.code == 0, run.stderr
    assert f"no report.html, no best_lap.png: the run has no trace: {why}" in run.stderr + run.stdout
    assert (run.folder / "learning.png").is_file()
    assert not (run.folder / "best_lap.png").exists()
    assert not list((run.folder / "trace").glob("*-iteration.parquet"))
    ended = call("analyze", str(run.folder))
    assert ended.code == 2, ended.stderr
    assert why in ended.stderr
    assert ended.stderr.count("\n") == 1


def test_a_page_of_laps_only_counts_all_episodes_and_says_nothing_of_failures(copied, monkeypatch):
    folder = copied()
    config = yaml.safe_load((folder / "config.yaml").read_text())
    (folder / "config.yaml").write_text(yaml.safe_dump(config | {"trace": "laps"}))
    whole = read_trace(folder / "trace")
    for path in (folder / "trace").iterdir():
        path.unlink()
    some = whole[whole.done].episode.tolist()[::2]
    writer = LapWriter(folder / "trace")
    for iteration, rows in whole.groupby("iteration"):
        packed = rows.reindex(columns=list(PACKED_COLUMNS), fill_value=0.0).assign(track=0)
        laps = rows.episode.isin(some) & rows.done
        packed["episode_status"] = rows.episode_status.astype(str).mask(laps, "lap_complete").map(STATUS_CODE)
        packed["progress"] = rows.progress.mask(laps, 100.0)
        writer.add(iteration, to_table(packed.to_numpy(np.float64), iteration, ["reinvent_base"]))
    writer.flush()
    recording = read_run_recording(folder)
    assert [problem.reason for problem in recording.recording.problems] == [LAPS_ONLY]
    view = prepare(recording)
    assert sorted(view.episodes["episode"]) == sorted(some)
    ended = whole[whole.done].groupby("iteration").size()
    counted = view.iterations.set_index("iteration")["episodes"]
    assert counted[ended.index].tolist() == ended.tolist()
    assert not {"runs_off", "crashes", "steering"} & {finding.rule for finding in findings(view)}
    of_failures = "Where it goes wrong"
    # The figures of the other sections take seconds.
    fewer = dict.fromkeys(log_report.SECTIONS, ()) | {of_failures: log_report.SECTIONS[of_failures]}
    monkeypatch.setattr(log_report, "SECTIONS", fewer)
    assert of_failures not in draw_sections(LogPage(view, []))
    everything = replace(view, run=replace(view.run, laps_only=False))
    assert of_failures in draw_sections(LogPage(everything, []))
