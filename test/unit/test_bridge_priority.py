"""Real-time scheduling: granted or not, and never a processor for good."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

linux = pytest.mark.skipif(not sys.platform.startswith('linux'), reason='Linux schedulers')
_GRANTED = 'SCHED_RR, priority'


def run(code: str) -> str:
    """Run code in a process of its own, whose scheduling may change."""
    text = 'import os, threading, time\nfrom bdgs_ros.bridge.priority import go_first\n' + code
    done = subprocess.run(
        [sys.executable, '-c', text], capture_output=True, text=True, timeout=60, check=True
    )
    return done.stdout.strip()


@linux
def test_all_threads_go_first_where_the_system_grants_it() -> None:
    code = """
policies = []
go = threading.Event()
def look():
    go.wait()
    policies.append(os.sched_getscheduler(threading.get_native_id()))
thread = threading.Thread(target=look)
thread.start()
note = go_first(1)
go.set()
thread.join()
later = threading.Thread(target=look)
later.start()
later.join()
print(note, policies == [os.SCHED_RR] * 2, policies == [os.SCHED_OTHER] * 2)
"""
    note = run(code)
    granted = _GRANTED in note
    assert note.endswith('True False' if granted else 'False True')
    assert granted or 'ordinary priorities' in note


@linux
def test_whether_it_would_be_granted_is_asked_and_nothing_changes() -> None:
    code = """
from bdgs_ros.bridge.priority import may_go_first
may = may_go_first(1)
same = os.sched_getscheduler(0) == os.SCHED_OTHER
print(same, may == ('SCHED_RR' in go_first(1) and os.sched_getscheduler(0) == os.SCHED_RR))
"""
    assert run(code) == 'True True'


@linux
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason='one processor')
def test_a_thread_that_never_sleeps_is_ordinary_again() -> None:
    code = """
import logging
from bdgs_ros.bridge import priority
warned = []
priority._log.addFilter(lambda record: warned.append(record.getMessage()))
note = go_first(1)
end = time.monotonic() + 3
while time.monotonic() < end and os.sched_getscheduler(0) != os.SCHED_OTHER:
    pass
print(note, warned, os.sched_getscheduler(0) == os.SCHED_OTHER)
"""
    found = run(code)
    if _GRANTED not in found:
        pytest.skip('real-time scheduling is not granted here')
    assert 'ordinary priorities from now on' in found
    assert found.endswith('True')


def test_priority_zero_asks_for_nothing() -> None:
    assert run('print(repr(go_first(0)))') == "''"


@pytest.mark.skipif(not hasattr(os, 'sched_setaffinity'), reason='Linux has it')
def test_a_process_keeps_to_the_processors_it_is_told() -> None:
    cpu = min(os.sched_getaffinity(0))
    script = f"""
import os, threading, time
from bdgs_ros.bridge.priority import keep_to
from bdgs_ros.core.errors import ConfigError
keep_to('')
found = []
early = threading.Thread(target=lambda: (time.sleep(0.3), found.append(os.sched_getaffinity(0))))
early.start()
keep_to('{cpu}')
early.join()
assert found == [os.sched_getaffinity(0)] == [{{{cpu}}}], found
for wrong in ('x', '1-2', '99999', '{cpu},'):
    try:
        keep_to(wrong)
    except ConfigError as error:
        assert wrong in str(error)
    else:
        raise AssertionError(wrong)
"""
    subprocess.run([sys.executable, '-c', script], check=True)
