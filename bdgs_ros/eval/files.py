"""The writers of result files; see `bdgs_ros.core.files`."""

from __future__ import annotations

from bdgs_ros.core.files import write_aside, write_text

__all__ = ['write_aside', 'write_text']
