"""Write docs/reference.md: every parameter and error code, from the code that defines them.

Usage: python scripts/reference.py [--check]. A test runs the check, so the page cannot go stale.
"""
import importlib
from pathlib import Path
import re
import sys
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / 'docs' / 'reference.md'
HEAD = """# Reference: parameters and error codes

Made by `make reference` from the code; do not edit. Topics, services and actions are in the
[README](../README.md); the files under `ros2_ws/src/ps_interfaces` explain every message field.
"""


def parameter_tables() -> str:
    """One table for each node, from its PARAMETERS."""
    from ps_inspection.graph import NODES
    parts = ['\n## Parameters\n\n'
             '*[start]*: read once, at start; the others can be set at run time.\n']
    for node in NODES:
        module = importlib.import_module(f'{node.package}.nodes.{node.executable}')
        parts.append(f'\n### {node.executable} ({node.package})\n\n'
                     '| parameter | default | range | meaning |\n| --- | --- | --- | --- |\n')
        parts += [f'| `{p.name}` | `{_show(p.default)}` | {_range(p)} | {p.description}'
                  f'{" *[start]*" if p.read_only else ""} |\n' for p in module.PARAMETERS]
    return ''.join(parts)


def _show(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'{value:.6g}' if isinstance(value, float) else repr(value)


def _range(parameter: Any) -> str:
    low, high, unit = parameter.minimum, parameter.maximum, parameter.unit
    if parameter.choices:
        return ', '.join(f'`{choice}`' for choice in parameter.choices)
    if low is None and high is None:
        return unit
    if high is None:
        return f'from {low:g} {unit}'.strip()
    if low is None:
        return f'up to {high:g} {unit}'.strip()
    return f'{low:g} to {high:g} {unit}'.strip()


def error_table() -> str:
    """All error codes with the comment of the interface file."""
    text = (ROOT / 'ros2_ws/src/ps_interfaces/msg/ErrorCode.msg').read_text()
    parts = ['\n## Error codes\n\nConstants of `ps_interfaces/msg/ErrorCode`.\n\n'
             '| code | name | meaning |\n| --- | --- | --- |\n']
    for name, code, comment in re.findall(r'^uint16 (\w+) = (\d+)[ ]*(?:# (.*))?$', text, re.M):
        parts.append(f'| {code} | `{name}` | {comment} |\n')
    return ''.join(parts)


def main() -> None:
    """Write the page, or say that it is stale."""
    page = HEAD + parameter_tables() + error_table()
    if '--check' in sys.argv:
        if not PAGE.is_file() or PAGE.read_text() != page:
            sys.exit(f'{PAGE.relative_to(ROOT)} is stale: run make reference')
        return
    PAGE.write_text(page)


if __name__ == '__main__':
    main()
