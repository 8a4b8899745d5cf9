"""How much memory this process has held at most."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

_CLEAR = Path('/proc/self/clear_refs')
_STATUS = Path('/proc/self/status')
_RESET_PEAK = '5'  # see proc(5)


def restart_peak() -> bool:
    """Forget the peak so far; False where the system cannot, and it is that since the start."""
    try:
        _CLEAR.write_text(_RESET_PEAK)
    except OSError:
        return False
    return True


def peak_mb() -> float:
    """Return the largest resident memory since `restart_peak`, or of the process, in MB."""
    try:
        for line in _STATUS.read_text().splitlines():
            if line.startswith('VmHWM:'):
                return int(line.split()[1]) * 1024 / 1e6
    except OSError:
        pass
    unit = 1 if sys.platform == 'darwin' else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
