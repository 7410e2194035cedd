"""Silences, with the use of processes and a clock made up, and of real processes that hang or compute."""

import signal
import subprocess
import sys
import time

import psutil
import pytest

from deepracer_exp.patience import Silence, Use, use_of, wait_patiently
from tests.waiting import wait_until


def counted(*looks: tuple[float, float, bool]) -> Silence:
    """Return the silence after looks at (clock, CPU seconds, whether a core is used or waited for)."""
    silence = Silence()
    for now_s, cpu_s, is_ready in looks:
        silence.look(Use(cpu_s, is_ready), now_s)
    return silence


def test_a_process_that_gets_a_tenth_of_a_core_is_granted_ten_times_as_long():
    silence = counted(*((look / 2, look / 20, True) for look in range(201)))
    assert silence.computed_s == pytest.approx(10.0)
    assert (silence.idle_s, silence.clock_s) == (0.0, 100.0)


def test_waiting_for_a_core_is_no_silence():
    silence = counted(*((look / 2, 3.0, True) for look in range(1000)))
    assert silence.computed_s + silence.idle_s == 0.0


def test_a_process_that_uses_no_cpu_is_counted_by_the_clock():
    assert counted(*((look / 2, 3.0, False) for look in range(41))).idle_s == pytest.approx(20.0)


def test_many_cores_count_as_one():
    assert counted((0.0, 0.0, True), (1.0, 16.0, True)).computed_s == pytest.approx(1.0)


def test_a_pause_of_the_one_who_looks_counts_as_a_second_at_most():
    assert counted((0.0, 1.0, False), (3600.0, 1.0, False)).idle_s == pytest.approx(1.0)


def test_a_child_that_is_gone_takes_nothing_back():
    assert counted((0.0, 5.0, False), (0.5, 1.0, False), (1.0, 1.5, False)).computed_s == pytest.approx(0.5)


@pytest.fixture
def python():
    """Start a process."""
    started = []

    def start(code: str) -> subprocess.Popen:
        started.append(subprocess.Popen([sys.executable, "-c", code]))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


def test_a_process_that_is_stopped_is_given_up(python):
    process = python("while True: pass")
    process.send_signal(signal.SIGSTOP)
    silence = wait_patiently(lambda seconds: time.sleep(seconds), 0.3, lambda: use_of(process.pid))
    assert silence is not None
    assert silence.idle_s > silence.computed_s


def test_the_cpu_of_what_a_process_has_started_is_its_own(python):
    code = "while True: pass"
    process = python(f"import subprocess, sys; subprocess.run([sys.executable, '-c', {code!r}])")
    (child,) = wait_until(psutil.Process(process.pid).children, "child")
    try:
        # No interpreter needs so much for its start.
        wait_until(lambda: use_of(process.pid).cpu_s > 1.5, "CPU of the child")
    finally:
        child.kill()


def test_nothing_is_counted_of_a_process_that_is_gone(python):
    process = python("")
    process.wait()
    assert use_of(process.pid) == Use(0.0, is_ready=False)


def waited(code: str) -> tuple[float, float]:
    """Return the idle and the computed seconds that a process of its own prints: threads of this one count as work."""
    code = "import threading, time\nfrom deepracer_exp.patience import wait_patiently\n" + code
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    idle_s, computed_s = map(float, done.stdout.split())
    return idle_s, computed_s


def test_waiting_is_no_work():
    idle_s, computed_s = waited("""
silence = wait_patiently(lambda seconds: time.sleep(seconds) or False, 0.4)
print(silence.idle_s, silence.computed_s)
""")
    assert idle_s > computed_s


def test_a_thread_that_computes_is_waited_for_by_its_cpu():
    idle_s, computed_s = waited("""
over = threading.Event()
threading.Thread(target=lambda: all(not over.is_set() for _ in iter(int, 1)), daemon=True).start()
silence = wait_patiently(lambda seconds: over.wait(seconds), 2.0)
over.set()
print(silence.idle_s, silence.computed_s)
""")
    assert computed_s > idle_s


def test_what_arrives_is_not_given_up_however_late():
    cpu = iter(range(1000))
    left = iter([False] * 5 + [True])
    assert wait_patiently(lambda _: next(left), 1e9, lambda: Use(next(cpu), is_ready=True)) is None
