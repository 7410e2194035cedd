"""What a command shows, and what happens where its output cannot be written or Ctrl-C comes early."""

import json
import os
import subprocess
import sys

import pytest

from deepracer_exp.commands.terminal import Terminal
from deepracer_exp.streams import shown

COMMAND = (sys.executable, "-m", "deepracer_exp.cli")
RUN = "20260101-120000-run"


def run(command, tmp_path, **streams):
    return subprocess.run(
        command, text=True, cwd=tmp_path, check=False, **{"stderr": subprocess.PIPE, **streams}
    )


@pytest.mark.parametrize("argument", ["--help", "tracks"])
def test_a_full_disk_takes_one_line(tmp_path, argument):
    with open("/dev/full", "w") as full:
        done = run((*COMMAND, argument), tmp_path, stdout=full)
    words = "deepracer-exp: standard output: cannot be written: No space left on device\n"
    assert (done.returncode, done.stderr) == (3, words)


@pytest.fixture
def closed_pipe():
    """Yield the writing end of a pipe that has no reader."""
    reading, writing = os.pipe()
    os.close(reading)
    yield writing
    os.close(writing)


def test_a_reader_that_has_left_is_no_error_of_ours(tmp_path, closed_pipe):
    done = run((*COMMAND, "--help"), tmp_path, stdout=closed_pipe)
    assert (done.returncode, done.stderr) == (141, "")


def test_what_cannot_be_read_any_more_does_not_end_a_command_halfway(tmp_path, closed_pipe):
    code = """
import sys
from deepracer_exp.commands.terminal import Terminal
from deepracer_exp.streams import exit_code, standard_streams
with standard_streams() as output:
    for _ in range(100):
        Terminal().print("x" * 100)
    print("done", file=sys.stderr)
    sys.exit(exit_code(output, 0))
"""
    done = run((sys.executable, "-c", code), tmp_path, stdout=closed_pipe)
    assert (done.returncode, done.stderr) == (141, "done\n")


@pytest.mark.parametrize("closed", [">&- 2>&- <&-", "2>/dev/full"])
def test_closed_streams_are_no_matter(tmp_path, closed):
    done = run(f"{sys.executable} -m deepracer_exp.cli --version {closed}", tmp_path, shell=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("module", ["deepracer_exp.commands.train", "rich.console", "rich.table"])
def test_ctrl_c_during_imports_takes_one_line(tmp_path, module):
    code = f"""
import os, signal, sys
class Press:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Press())
sys.argv[1:] = ["tracks"]
from deepracer_exp.cli import main
main()
"""
    done = run((sys.executable, "-c", code), tmp_path, stdout=subprocess.PIPE)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "deepracer-exp: interrupted\n")


@pytest.fixture
def strange_run(tmp_path):
    """Make a run whose owner has written escape sequences into its labels."""
    folder = tmp_path / "runs" / "e" / RUN
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("name: e\n")
    labels = {"name": "\x1b]0;title\x07\x1b[2J", "note": "a\x9b2Jb\u202e", "tags": {"key": "\x1b[31m"}}
    (folder / "labels.json").write_text(json.dumps(labels))


@pytest.mark.usefixtures("strange_run")
@pytest.mark.parametrize("form", ["table", "csv", "json"])
def test_what_a_stranger_wrote_into_a_run_is_shown_as_text(call, form):
    ended = call("runs", "list", "--format", form)
    assert RUN in ended.stdout
    assert all(letter.isprintable() or letter == "\n" for letter in ended.stdout)


def test_a_terminal_styles_its_own_text_and_obeys_no_other(capsys):
    console = Terminal(force_terminal=True, color_system="standard")
    console.print("\x1b[2Jtext", style="bold", highlight=False, markup=False)
    assert capsys.readouterr().out == "\x1b[1m\N{REPLACEMENT CHARACTER}[2Jtext\x1b[0m\n"


MASKED = "*" * 12


@pytest.mark.parametrize(
    ("text", "seen"),
    [
        ("arn:aws:deepracer:us-east-1:123456789012:model/x", f"arn:aws:deepracer:us-east-1:{MASKED}:model/x"),
        ("aws-deepracer-123456789012/training.log", f"aws-deepracer-{MASKED}/training.log"),
        ("sagemaker-us-east-1-123456789012", f"sagemaker-us-east-1-{MASKED}"),
        ("s3://123456789012-logs/a", f"s3://{MASKED}-logs/a"),
        *((text, text) for text in ("0.123456789012", "sha256 123456789012", "job-202611281530.log")),
        *((text, text) for text in ("20261127-172644-run", "1234567890123", "000000000512-000000001024")),
    ],
)
def test_the_number_of_an_account_is_not_shown(text, seen):
    assert shown(text) == seen
