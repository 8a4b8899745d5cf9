"""Fixtures that every test may use."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

# A shell starts what runs in its background deaf to Ctrl-C, and so would be all that tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope='session')
def shared_dir() -> Path:
    """Return the folder of real recordings and weights, or skip where there is none."""
    default = Path(__file__).resolve().parents[2] / 'shared'
    folder = Path(os.environ.get('BDGS_SHARED', default))
    if not (folder / 'data').is_dir():
        pytest.skip(f"no recordings: '{folder}/data' is absent; set BDGS_SHARED to their folder")
    return folder
