"""A command ends with the exit code it has come to, whatever its process does."""

import os
import signal
import subprocess
import sys

import psutil
import pytest

from tests.waiting import wait_until

HEAD = """
import os, signal, sys, time
from deepracer_exp.cli import supervised
from deepracer_exp.training.signals import Interruption
def call():
    {body}
sys.exit(supervised(call))
"""
LISTENS = """
    with Interruption() as interruption:
        print("listens", flush=True)
        for _ in range(20_000):
            time.sleep(0.05)
            if interruption.signum:
                time.sleep(0.5)  # a second signal, which ends at once, would arrive by now
                return interruption.exit_code
"""


def command(body: str, **options: object) -> subprocess.Popen[str]:
    text = HEAD.format(body=body)
    return subprocess.Popen(
        [sys.executable, "-c", text], stdout=-1, stderr=-1, text=True, start_new_session=True, **options
    )


def test_a_command_ends_at_once_but_with_all_that_must_be_done_first() -> None:
    code = """
import atexit, sys, threading, time
from deepracer_exp.cli import end_process
class Never:
    def __del__(self):
        print("taken apart", flush=True)
never = Never()
atexit.register(print, "exit function")
threading.Thread(target=lambda: (time.sleep(0.2), print("thread"))).start()
sys.stdout.write("unflushed ")
end_process(3)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (3, "")
    assert done.stdout == "unflushed thread\nexit function\n"


@pytest.mark.parametrize("code", [0, 2, 143])
def test_the_exit_code_is_the_calls_own(code: int) -> None:
    process = command(f"print('done'); return {code}")
    assert process.communicate() == ("done\n", "")
    assert process.returncode == code


@pytest.mark.parametrize(
    ("body", "how"),
    [
        ("os._exit(0)", "left it with exit code 0"),
        ("os._exit(7)", "left it with exit code 7"),
        ("sys.exit(0)", "left it with exit code 0"),
        ("os.execv('/bin/true', ['true'])", "left it with exit code 0"),
        ("os.close(1); os.close(2); os._exit(0)", "left it with exit code 0"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "was ended by SIGKILL"),
        ("os.kill(os.getpid(), signal.SIGSEGV)", "was ended by SIGSEGV"),
        ("os.fork() or time.sleep(600); os._exit(0)", "left it with exit code 0"),
    ],
)
def test_a_call_that_never_returns_never_ends_with_0(body: str, how: str) -> None:
    process = command(body)
    line = process.stderr.readline()
    assert process.wait() == 3
    assert line == (
        f"deepracer-exp: the process {how} before the command was done; a reward function can do that\n"
    )
    if "fork" in body:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


@pytest.mark.parametrize("whom", [os.kill, os.killpg])
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_heard_once_whether_one_process_or_the_group_gets_it(whom, signum) -> None:
    process = command(LISTENS)
    assert process.stdout.readline() == "listens\n"
    whom(process.pid, signum)
    assert process.wait() == 128 + signum, process.stderr.read()
    assert process.communicate() == ("", "")


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    ("dies", "how"), [("os.abort()", "was ended by SIGABRT"), ("os._exit(0)", "left it with exit code 0")]
)
def test_a_signal_that_was_passed_on_is_the_exit_code_however_the_child_dies_of_it(signum, dies, how) -> None:
    hears = "signal.signal(signal.SIGINT, dies); signal.signal(signal.SIGTERM, dies)"
    body = f"dies = lambda *_: {dies}; {hears}; print('listens', flush=True); time.sleep(600)"
    process = command(body)
    assert process.stdout.readline() == "listens\n"
    os.killpg(process.pid, signum)
    assert process.wait() == 128 + signum
    line = f"deepracer-exp: interrupted; the process {how} before the command was done\n"
    assert process.communicate() == ("", line)


def test_the_child_dies_with_its_supervisor() -> None:
    process = command("print(os.getpid(), flush=True); time.sleep(600)")
    child = int(process.stdout.readline())
    process.kill()
    process.wait()
    wait_until(lambda: not psutil.pid_exists(child), "end of the child")
    process.communicate()
