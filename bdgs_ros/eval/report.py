"""One self-contained page about one run: figures, pictures, and how they were made."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bdgs_ros.core.files import write_text
from bdgs_ros.eval.metric import Metric, format_value

_TYPES = {'.png': 'image/png', '.gif': 'image/gif', '.jpg': 'image/jpeg'}

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #0b0b0b; background: #fcfcfb;
       max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: .2rem; }
h2 { font-size: 1.1rem; margin: 2rem 0 .5rem; }
table { border-collapse: collapse; }
td, th { padding: .2rem .9rem .2rem 0; border-bottom: 1px solid #e4e3df; text-align: left;
         vertical-align: top; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
img { max-width: 100%; }
code { font-size: .9em; overflow-wrap: anywhere; }
figure { margin: 1rem 0; } figcaption { color: #52514e; }
"""


@dataclass(frozen=True)
class Row:
    """One figure of the report, explained."""

    meaning: str
    metric: Metric


@dataclass(frozen=True)
class Picture:
    """A picture file and what it shows."""

    path: Path
    caption: str


@dataclass(frozen=True)
class Report:
    """What the page says."""

    title: str
    lead: str
    rows: Sequence[Row] = ()
    pictures: Sequence[Picture] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    """How it was made: commands, commit, machine."""


def write_report(path: Path, report: Report) -> None:
    """
    Write the page as one .html file with the pictures inside; missing pictures are left out.

    Raises
    ------
    OSError
        If the file cannot be written; an old one stays.

    """
    body = [
        f'<h1>{html.escape(report.title)}</h1>',
        f'<p>{html.escape(report.lead)}</p>',
        _table(report.rows),
        *(_figure(picture) for picture in report.pictures if picture.path.is_file()),
        _facts(report.facts),
    ]
    write_text(
        path,
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<title>{html.escape(report.title)}</title><style>{_STYLE}</style></head>\n<body>\n'
        + '\n'.join(part for part in body if part)
        + '\n</body></html>\n',
    )


def _table(rows: Sequence[Row]) -> str:
    if not rows:
        return ''
    lines = [
        f'<tr><td>{html.escape(row.meaning)}</td>'
        f'<td class="number">{format_value(row.metric.value)}</td>'
        f'<td>{html.escape(row.metric.unit)}</td></tr>'
        for row in rows
    ]
    return '<h2>Figures</h2>\n<table>' + '\n'.join(lines) + '</table>'


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.path.read_bytes()).decode('ascii')
    kind = _TYPES[picture.path.suffix]
    caption = html.escape(picture.caption)
    return (
        f'<figure><img alt="{caption}" src="data:{kind};base64,{data}">'
        f'<figcaption>{caption}</figcaption></figure>'
    )


def _facts(facts: Mapping[str, str]) -> str:
    if not facts:
        return ''
    lines = [
        f'<tr><td>{html.escape(name)}</td><td><code>{html.escape(text)}</code></td></tr>'
        for name, text in facts.items()
    ]
    return '<h2>How it was made</h2>\n<table>' + '\n'.join(lines) + '</table>'
