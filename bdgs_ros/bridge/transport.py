"""
Give Fast DDS a shared-memory segment that images fit into, and quicker discovery.

The default segment of 512 KiB loses every second 640x480 image between two processes; with 64 MiB
none is lost and the 95th percentile of the latency falls from 17-63 ms to 7-10 ms. By default a
participant that missed the first announcements waits 3 s for the next ones.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

PROFILES_VARIABLES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
SEGMENT_BYTES = 64 * 1024 * 1024
_SMALLEST_BYTES = 4 * 1024 * 1024
_SHARE_OF_FREE = 8  # a graph has several participants, each with its own segment

_PROFILE = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>bdgs_shm</transport_id>
      <type>SHM</type>
      <segment_size>{segment}</segment_size>
    </transport_descriptor>
    <transport_descriptor>
      <transport_id>bdgs_udp</transport_id>
      <type>UDPv4</type>
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="bdgs_participant" is_default_profile="true">
    <rtps>
      <builtin>
        <discovery_config>
          <leaseAnnouncement><sec>0</sec><nanosec>500000000</nanosec></leaseAnnouncement>
          <initialAnnouncements>
            <count>20</count>
            <period><sec>0</sec><nanosec>100000000</nanosec></period>
          </initialAnnouncements>
        </discovery_config>
      </builtin>
      <useBuiltinTransports>false</useBuiltinTransports>
      <userTransports>
        <transport_id>bdgs_shm</transport_id>
        <transport_id>bdgs_udp</transport_id>
      </userTransports>
    </rtps>
  </participant>
</profiles>
"""


def configure(shm: Path = Path('/dev/shm')) -> str:
    """
    Point Fast DDS at our profile; call it before `rclpy.init`.

    Whatever the user has set wins: another profile, or another middleware.

    Returns
    -------
    note : str
        What was done, for the log.

    """
    for name in PROFILES_VARIABLES:
        if os.environ.get(name):
            return f'transport: {name} is set by the user'
        os.environ.pop(name, None)  # set but empty, Fast DDS would try to open it
    middleware = os.environ.get('RMW_IMPLEMENTATION', '')
    if middleware and 'fastrtps' not in middleware:
        return f'transport: {middleware} has its own defaults'
    segment = _affordable_segment(shm)
    if segment < _SMALLEST_BYTES:
        return f"transport: too little room in '{shm}', default segment; images may be lost"
    path = _write_profile(segment)
    os.environ[PROFILES_VARIABLES[0]] = str(path)
    return f'transport: shared-memory segment of {segment >> 20} MiB'


def _affordable_segment(shm: Path) -> int:
    try:
        free = shutil.disk_usage(shm).free
    except OSError:
        return 0
    return min(SEGMENT_BYTES, free // _SHARE_OF_FREE >> 20 << 20)


def _write_profile(segment: int) -> Path:
    """Write the profile once per size; atomically, since nodes start at the same time."""
    path = _cache_folder() / f'fastdds-{segment >> 20}mib.xml'
    text = _PROFILE.format(segment=segment)
    if path.is_file() and path.read_text(encoding='utf-8') == text:
        return path
    with tempfile.NamedTemporaryFile(
        'w', dir=path.parent, suffix='.xml', delete=False, encoding='utf-8'
    ) as file:
        file.write(text)
    Path(file.name).replace(path)
    return path


def _cache_folder() -> Path:
    home = os.environ.get('XDG_CACHE_HOME') or os.environ.get('HOME')
    if home:
        base = Path(home) if os.environ.get('XDG_CACHE_HOME') else Path(home) / '.cache'
        try:
            (base / 'bdgs_ros').mkdir(parents=True, exist_ok=True)
            if os.access(base / 'bdgs_ros', os.W_OK):
                return base / 'bdgs_ros'
        except OSError:
            pass
    return Path(tempfile.mkdtemp(prefix='bdgs_ros-'))
